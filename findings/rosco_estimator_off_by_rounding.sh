#!/bin/sh
# ROSCO 2.10.6 (wheel of PyPI, deck NREL-5MW as it is): the wind estimator switches itself off although
# no input leaves its bounds.
#
# Where the pitch falls to PC_MinPit (0 in most decks), the last rate limit computes
# last + ((0 - last) / DT) * DT, which rounding takes below 0. The estimator compares the pitch with
# PC_MinPit exactly, prints a warning once, and hands out the filtered hub wind; when the
# sign turns it starts its Kalman filter anew.
#
# Seen with 2.10.6 on Linux, x86-64: the pitch falls below PC_MinPit = 0 several times in 600 s, by less
# than 1e-15 rad. The script fails if it no longer does.
#
#   sh findings/rosco_estimator_off_by_rounding.sh      (needs python3 with pip, and a package index)
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m pip install --quiet --no-deps --target packages rosco==2.10.6
python3 - <<'P'
import ctypes
import math
import re
import shutil
import sys
from pathlib import Path

root = Path("packages").resolve()
deck = root / "Examples/Test_Cases/NREL-5MW"
shutil.copy(deck / "Cp_Ct_Cq.NREL5MW.txt", ".")
text = (deck / "DISCON.IN").read_text()
Path("DISCON.IN").write_text(re.sub(r"(?m)^\d+(\s*! LoggingLevel)", r"0\1", text))
call = ctypes.CDLL(str(root / "rosco/lib/libdiscon.so")).DISCON
swap, fail = (ctypes.c_float * 4000)(), ctypes.c_int32(0)
message = ctypes.create_string_buffer(1024)
swap[2], swap[48], swap[49], swap[50], swap[60] = 0.05, 1024, 10, 4, 3
swap[3] = swap[32] = swap[33] = 0.09
least, below = 0.0, 0
for k in range(12000):
    t = 0.05 * k
    # Around rated speed: the pitch comes and goes between 0 and a few degrees.
    speed = 115.0 + 10.0 * math.sin(2 * math.pi * t / 40)
    swap[0], swap[1] = (0 if k == 0 else 1), t
    swap[19], swap[20], swap[26], swap[14] = speed, speed / 97, 9.0, 4.9e6
    call(swap, ctypes.byref(fail), b"DISCON.IN", b"run", message)
    below += swap[41] < 0
    least = min(least, swap[41])
print(f"pitch below PC_MinPit = 0 in {below} of 12000 calls, by at most {-least:.2g} rad")
sys.exit(0 if 0 < -least < 1e-15 else "the pitch no longer falls below PC_MinPit by rounding")
P
