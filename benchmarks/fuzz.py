"""Mutated inputs of every kind: each is read as it was, or refused in one sentence.

``python -m benchmarks fuzz --inputs 20000 --seed 0``. A worker process reads them; what ends it or
takes too long is told with its seed, by which ``mutated(kind, seed)`` makes the input again.
"""

from __future__ import annotations

import json
import queue
import resource
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fuzz_samples import Sample, samples
from dfsm.errors import DfsmError, hushed

# Bytes that a worker may take, and seconds after which one input counts as hanging.
_MEMORY, _PATIENCE = 6_000_000_000, 60
# What texts are damaged with: ends of number ranges, other types, and what parsers stumble over.
_WORDS = (
    *("nan", "inf", "-inf", "1e309", "-0", "0", "-1", "1e-320", "9" * 40, "2147483648", "1.0D-01"),
    *("true", "null", '""', "[]", "{}", "[[[[[[[[", "../../x", "=1+1", "\u00b7", "\x00", "\ufeff"),
    *("&a", "*a", "<<: *a", "!!set", "!!binary", "2001-13-45", "~", "|", "? ", "- ", "\t", "****"),
)
_VALUES = (
    *(None, True, -1, 0, 1, 2, 10**6, 10**12, 10**30, 1.5, float("1e308"), "", "x", "../../x"),
    *([], {}, [1], [[]], {"x": 1}, "nan", "\ud800"),
)


def mutated(sample: Sample, seed: int) -> bytes:
    """One damaged copy of a sample.

    Parameters
    ----------
    sample
        What to damage.
    seed
        The same seed gives the same bytes.
    """
    rng = np.random.default_rng([seed, *sample.name.encode()])
    if sample.signed is not None and rng.random() < 0.7:
        return sample.signed(_other(rng, json.loads(sample.raw)))
    raw = bytearray(sample.raw)
    for _ in range(int(rng.integers(1, 4))):
        if not raw:
            break
        at = int(rng.integers(len(raw)))
        length = int(min(rng.integers(1, 40), len(raw) - at))
        match int(rng.integers(6)):
            case 0 | 1:
                raw[at] ^= 1 << int(rng.integers(8))
            case 2:
                del raw[at : at + length]
            case 3:
                raw[at:at] = raw[at : at + length] * int(rng.integers(1, 4))
            case 4:
                del raw[at:]
            case _:
                word = _WORDS[int(rng.integers(len(_WORDS)))].encode()
                raw[at : at + int(rng.integers(0, 9))] = word
    return bytes(raw)


def _other(rng: np.random.Generator, tree: Any) -> Any:
    """A tree of JSON with one to three of its nodes changed, lost or repeated."""
    for _ in range(int(rng.integers(1, 4))):
        nodes = list(_nodes(tree))
        if not nodes:
            return tree
        node, key = nodes[int(rng.integers(len(nodes)))]
        match int(rng.integers(5)):
            case 0:
                del node[key]
            case 1 if isinstance(node[key], list) and node[key]:
                node[key] = node[key] * 2
            case 2 if isinstance(node[key], int | float) and not isinstance(node[key], bool):
                node[key] = node[key] * int(rng.choice([-1, 2, 1000])) + int(rng.integers(-1, 2))
            case _:
                # Its own, or what is damaged next damages the list.
                node[key] = deepcopy(_VALUES[int(rng.integers(len(_VALUES)))])
    return tree


def _nodes(tree: Any) -> Iterator[tuple[Any, Any]]:
    pairs = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in list(pairs):
        yield tree, key
        if isinstance(value, dict | list):
            yield from _nodes(value)


@dataclass(frozen=True)
class Fault:
    """An input that was neither read as it was nor refused in one sentence."""

    kind: str
    seed: int
    what: str


def check(sample: Sample, seed: int, folder: Path) -> str:
    """Read one damaged input; what went wrong, or "" where nothing did."""
    raw = mutated(sample, seed)
    path = sample.put(raw, folder)
    try:
        with hushed():
            told = sample.read(path)
    except DfsmError as error:
        return f"{str(error)!r} is no one sentence" if "\n" in str(error) else ""
    except MemoryError:
        return "out of memory"
    except Exception as error:
        return f"{type(error).__name__}: {error}"[:300]
    # A sample that was signed again says something else by right.
    unsigned = sample.checked and (sample.signed is None or not sample.is_signed(raw))
    return "read as something else" if unsigned and told != sample.told else ""


def worker(kind: str, first: int, count: int) -> None:
    """Check inputs and print one line per input that begins, and one per fault."""
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    with tempfile.TemporaryDirectory() as base:
        sample = samples(Path(base), kind)[kind]
        for seed in range(first, first + count):
            print(json.dumps({"at": seed}), flush=True)
            if what := check(sample, seed, Path(base)):
                print(json.dumps({"at": seed, "what": what}), flush=True)


def fuzz(kind: str, first: int, count: int) -> Iterator[Fault]:
    """Check inputs in worker processes, a new one after each that ended or hung."""
    last = first + count
    while first < last:
        code = f"from benchmarks.fuzz import worker; worker({kind!r}, {first}, {last - first})"
        errors = tempfile.TemporaryFile("w+")  # noqa: SIM115
        process = subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=errors, text=True
        )
        at, ended = first, ""
        for line in _lines(process):
            if line is None:
                process.kill()
                ended = f"took more than {_PATIENCE} s"
                break
            told = json.loads(line)
            at = told["at"]
            if "what" in told:
                yield Fault(kind, at, told["what"])
        if process.wait() == 0:
            return
        errors.seek(0)
        yield Fault(kind, at, ended or f"exit {process.returncode}: {errors.read()[-200:]}")
        first = at + 1


def _lines(process: subprocess.Popen[str]) -> Iterator[str | None]:
    """Lines of a process; None, and no more, where one is long in coming."""
    lines: queue.Queue[str] = queue.Queue()

    def pass_on() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            lines.put(line)
        lines.put("")

    threading.Thread(target=pass_on, daemon=True).start()
    while True:
        try:
            line = lines.get(timeout=_PATIENCE)
        except queue.Empty:
            yield None
            return
        if not line:
            return
        yield line


def run(inputs: int = 20_000, seed: int = 0) -> dict[str, Any]:
    """Damage `inputs` inputs, spread evenly over the kinds; the faults by kind."""
    with tempfile.TemporaryDirectory() as base:
        kinds = list(samples(Path(base)))
    share = -(-inputs // len(kinds))
    figures: dict[str, Any] = {"seed": seed, "inputs": share * len(kinds)}
    for kind in kinds:
        faults = list(fuzz(kind, seed * 1_000_000, share))
        figures[kind] = {"faults": len(faults), "first": [[f.seed, f.what] for f in faults[:20]]}
        print(f"{kind}: {share} inputs, {len(faults)} faults", file=sys.stderr, flush=True)
    return figures
