#!/bin/sh
# HAWC2's binary results (.sel with .dat), read with DTU's own Wind Energy Toolbox, wetb 0.1.33 of PyPI:
# neither the times that the reader hands out nor those in the file are when the samples were taken.
#
# The reader makes times of its own, from 0 to the length of the record. A run that writes results
# after its start-up, as most do, begins elsewhere: what its first channel, the time, says is lost.
# That channel is stored like all others, as 16-bit codes of which the largest value is 32000: over
# some minutes neighbouring scans get the same code, so that the times in the file repeat. Both
# together tell: the step comes from the .sel, the start from the channel.
#
# Seen with wetb 0.1.33 and the results of a bearing that it brings for its tests (30000 scans in
# 600 s): times of the reader 0.02 to 600 s, of the channel 100.012 to 700 s, 2,571 of them (8.6 %)
# no later than the one before. The script fails if this changes.
#
#   sh findings/hawc2_binary_times.sh      (needs python3 with pip, and a package index)
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check wetb==0.1.33
venv/bin/python - <<'P'
import sys
from pathlib import Path

import numpy as np
import wetb
from wetb.hawc2.Hawc2io import ReadHawc2

root = Path(wetb.__file__).parent
result = ReadHawc2(str(root / "fatigue_tools/tests/test_files/test_bearing_damage"))
channel = result.ReadBinary([0])[:, 0]
print(f"times of the reader:  {result.t[0]:.3f} to {result.t[-1]:.3f} s")
print(f"times in the file:    {channel[0]:.3f} to {channel[-1]:.3f} s, {result.ChInfo[0][0]}")
steps = np.diff(channel)
repeated = int((steps <= 0).sum())
print(f"scans no later than the one before: {repeated} of {len(channel)}")
as_seen = abs(result.t[0] - 0.02) < 1e-9 and channel[0] > 99 and repeated > 1000
sys.exit(0 if as_seen else 1)
P
