#!/bin/sh
# ROSCO 2.10.6: the wind estimator switches itself off although no input leaves its bounds.
# Where the pitch falls to PC_MinPit (0 in most decks), the last rate limit computes
# last + ((0 - last)/DT)*DT, which rounding takes below 0 by last * 1e-17; the estimator compares the
# pitch with PC_MinPit exactly, prints its warning, and takes the filtered hub wind; when the sign turns
# it starts its Kalman filter anew. Deck: NREL-5MW of the wheel as it is; ordinary inputs.
#   pip install --no-deps rosco==2.10.6 ; PY=path/to/its/python sh rosco_estimator_off_by_rounding.sh
PY=${PY:-python3}
work=$(mktemp -d); cd "$work"
"$PY" - <<'P'
import ctypes, math, importlib.util, os, re, shutil
root = os.path.dirname(list(importlib.util.find_spec("rosco").submodule_search_locations)[0])
deck = os.path.join(root, "Examples/Test_Cases/NREL-5MW")
shutil.copy(os.path.join(deck, "Cp_Ct_Cq.NREL5MW.txt"), ".")
text = open(os.path.join(deck, "DISCON.IN")).read()
open("DISCON.IN", "w").write(re.sub(r"(?m)^\d+(\s*! LoggingLevel)", r"0\1", text))
f = ctypes.CDLL(os.path.join(root, "rosco/lib/libdiscon.so")).DISCON
swap, fail = (ctypes.c_float * 4000)(), ctypes.c_int32(0)
msg = ctypes.create_string_buffer(1024)
swap[2], swap[48], swap[49], swap[50], swap[60] = 0.05, 1024, 10, 4, 3
swap[3] = swap[32] = swap[33] = 0.09
least = 0.0
for k in range(12000):
    t = 0.05 * k
    # Around rated: the pitch comes and goes between 0 and a few deg, never below PC_MinPit = 0.
    speed = 115.0 + 10.0 * math.sin(2 * math.pi * t / 40)
    swap[0], swap[1] = (0 if k == 0 else 1), t
    swap[19], swap[20], swap[26], swap[14] = speed, speed / 97, 9.0, 4.9e6
    f(swap, ctypes.byref(fail), b"DISCON.IN", b"run", msg)
    if swap[41] < least:
        least = swap[41]
        print(f"t={t:6.2f}  pitch={swap[41]:.3g} rad: below PC_MinPit = 0", flush=True)
print("largest shortfall below PC_MinPit:", least)
P
