"""A model as a folder: arrays in safetensors, everything else in a readable JSON manifest.

Nothing in the folder is executed when it is read. The arrays are stored in 64 bits, so a model
predicts bit for bit the same after it has been saved and loaded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from pydantic import TypeAdapter

from dfsm.core.bundle import MANIFEST, Bundle
from dfsm.core.exchange import recover
from dfsm.core.files import check_folder, visible
from dfsm.core.types import Array
from dfsm.errors import DfsmError
from dfsm.models.corrective import FORMS, Corrective
from dfsm.models.dfsm import DFSM, require_model
from dfsm.models.folder_check import RecordCheck, check_model
from dfsm.models.linear import LinearModel
from dfsm.models.passing import Passing
from dfsm.models.region import Region
from dfsm.models.signals import Provenance, SignalTable
from dfsm.models.terms import ScalarFunction, Terms, restored_term, told_term

FORMAT = 1
TENSORS = "model.safetensors"
MULTI_FIDELITY, NONLINEAR = "multi-fidelity", "nonlinear-only"
_BUNDLE = Bundle(TENSORS, FORMAT, "fit the model again")


def save(model: DFSM, path: str | Path, nonlinear: DFSM | None = None) -> None:
    """Write a model folder; an existing model folder there is replaced in one step.

    Parameters
    ----------
    model
        The multi-fidelity model.
    path
        Folder to make.
    nonlinear
        The nonlinear-only model to keep beside it for comparisons.

    Raises
    ------
    DfsmError
        `path` holds something else, or cannot be written.
    """
    models = {MULTI_FIDELITY: model} | ({NONLINEAR: nonlinear} if nonlinear is not None else {})
    for one in models.values():
        require_model(one)
    tensors: dict[str, Array] = {}
    structure = {name: _take_apart(m, name, tensors) for name, m in models.items()}
    content = {
        "signals": asdict(model.signals),
        "models": structure,
        "provenance": dict(model.provenance.record),
    }
    _BUNDLE.write(path, tensors, content, _is_model)


def check_target(path: str | Path) -> None:
    """Fail early where `save` would fail: before hours of work, not after.

    Raises
    ------
    DfsmError
        `path` exists and is not a model folder, or its parent does not exist.
    """
    check_folder(path, is_ours=_is_model)


def load(path: str | Path, functions: Mapping[str, ScalarFunction] | None = None) -> DFSM:
    """Read the multi-fidelity model of a model folder.

    Parameters
    ----------
    path
        The folder.
    functions
        The Python functions of the model's terms by name, which no folder holds, see `Function`.

    Raises
    ------
    DfsmError
        The folder is missing, not a model, damaged, or written by a newer version, or a function
        is missing.
    """
    return load_all(path, functions)[MULTI_FIDELITY]


def load_all(
    path: str | Path, functions: Mapping[str, ScalarFunction] | None = None
) -> dict[str, DFSM]:
    """Read all models of a model folder by name: multi-fidelity, and nonlinear-only if kept.

    Parameters
    ----------
    path, functions
        As for `load`.
    """
    path = Path(path)
    manifest = _read_manifest(path)
    tensors = _BUNDLE.read_tensors(path, manifest)
    try:
        signals, provenance = _about(manifest)
        models = {
            name: _put_together(structure, name, tensors, (signals, provenance), functions or {})
            for name, structure in manifest["models"].items()
        }
        if MULTI_FIDELITY not in models:
            raise KeyError(MULTI_FIDELITY)
        for model in models.values():
            check_model(model)
    except _GARBLED as error:
        raise _BUNDLE.damaged(
            path, f"its {MANIFEST} lacks or garbles {error}".split("\n")[0]
        ) from None
    return models


# -- taking apart and putting together ----------------------------------------------------------


def _take_apart(model: DFSM, prefix: str, tensors: dict[str, Array]) -> dict[str, Any]:
    """Put the arrays of a model under ``prefix/…`` into `tensors`; return the rest."""

    def keep(name: str, module: Any, fields: tuple[str, ...]) -> None:
        for field in fields:
            tensors[f"{prefix}/{name}/{field}"] = np.asarray(getattr(module, field))

    structure: dict[str, Any] = {
        "corrected": list(model.corrected),
        "corrected_outputs": list(model.corrected_outputs),
        "latents": len(model.signals.latents),
    }
    keep("region", model.region, _REGION)
    structure["region"] = {"fixed": model.region.fixed, "schedule": model.region.schedule}
    for name, linear in (("f", model.f), ("g", model.g)):
        structure[name] = None
        if linear is not None:
            keep(name, linear, _LINEAR)
            structure[name] = {"schedule": linear.schedule, "known": linear.known}
    for name, corrective in (("e", model.e), ("e_g", model.e_g)):
        structure[name] = None
        if corrective is not None:
            for field, array in corrective.arrays().items():
                tensors[f"{prefix}/{name}/{field}"] = np.asarray(array)
            structure[name] = corrective.structure()
    structure["terms"] = []
    for k, term in enumerate(model.terms.parts if model.terms is not None else ()):
        for field, array in term.arrays().items():
            tensors[f"{prefix}/terms{k}/{field}"] = np.asarray(array)
        structure["terms"].append(told_term(term))
    if model.terms is not None:
        keep("terms", model.terms, ("mean", "std"))
    structure["passing"] = None
    if model.passing is not None:
        keep("passing", model.passing, _PASSING)
        structure["passing"] = {"column": model.passing.column}
    return structure


_REGION = ("low", "high", "mean", "std", "grid", "operating", "whitening")
_NO_DENSITY = np.zeros((0, 0, 0))  # of models that were saved before they had one
_LINEAR = ("grid", "coefficients", "offsets")
_PASSING = ("coefficients", "speed", "schedule")


# What Python, JAX and pydantic say of parts that do not fit together.
_GARBLED = (KeyError, TypeError, AttributeError, ValueError, IndexError, OverflowError)


def _about(manifest: Mapping[str, Any]) -> tuple[SignalTable, Provenance]:
    """Signals and history, checked."""
    try:
        signals = TypeAdapter(SignalTable).validate_python(manifest["signals"])
    except DfsmError as error:
        # Of a settings class, which speaks of a configuration.
        raise ValueError(f"signals ({error})") from None
    RecordCheck.model_validate(manifest["provenance"])
    return signals, Provenance(manifest["provenance"])


def _put_together(
    structure: Mapping[str, Any],
    prefix: str,
    tensors: Mapping[str, Array],
    about: tuple[SignalTable, Provenance],
    functions: Mapping[str, ScalarFunction],
) -> DFSM:
    signals, provenance = about
    complete = {f"{prefix}/region/whitening": _NO_DENSITY, **tensors}

    def arrays(name: str) -> dict[str, Any]:
        start = f"{prefix}/{name}/"
        return {
            key.removeprefix(start): jax.device_put(array)
            for key, array in complete.items()
            if key.startswith(start)
        }

    def linear(name: str) -> LinearModel | None:
        told = structure[name]
        if told is None:
            return None
        known = tuple((int(row), int(column)) for row, column in told.get("known", ()))
        grid, coefficients, offsets = (arrays(name)[field] for field in _LINEAR)
        return LinearModel(grid, coefficients, offsets, told["schedule"], known)

    def corrective(name: str) -> Corrective | None:
        told = structure[name]
        return None if told is None else FORMS[told["kind"]].restored(arrays(name), told)

    def terms() -> Terms | None:
        if not structure.get("terms"):
            return None
        parts = [
            restored_term(told, arrays(f"terms{k}"), functions)
            for k, told in enumerate(structure["terms"])
        ]
        return Terms(parts=tuple(parts), **arrays("terms"))

    def passing() -> Passing | None:
        told = structure.get("passing")
        return None if told is None else Passing(**arrays("passing"), column=int(told["column"]))

    region = {field: arrays("region")[field] for field in _REGION}
    f = linear("f")
    if f is None:
        raise KeyError("f")
    latents = structure.get("latents", 0)
    if latents not in (0, len(signals.latents)):
        raise ValueError(f"latents, which are {len(signals.latents)} in its signals")
    if not latents:
        # The nonlinear-only model beside a refined one has none.
        signals = replace(signals, states=signals.observed, latents=(), induced=0)
    return DFSM(
        f=f,
        e=corrective("e"),
        g=linear("g"),
        e_g=corrective("e_g"),
        region=Region(**region, **structure.get("region", {})),
        corrected=tuple(structure["corrected"]),
        corrected_outputs=tuple(structure["corrected_outputs"]),
        signals=signals,
        provenance=provenance,
        terms=terms(),
        passing=passing(),
    )


# -- reading safely -----------------------------------------------------------------------------


def _is_model(path: Path) -> bool:
    # Both files: other programs write a manifest.json too.
    return visible(path) == {MANIFEST, TENSORS}


def _read_manifest(path: Path) -> dict[str, Any]:
    recover(path)
    if not path.is_dir():
        kind = "a file" if path.exists() else "missing"
        raise DfsmError(f"{path} is {kind}; a model folder as 'dfsm fit' writes it was expected")
    if not (path / MANIFEST).exists():
        raise DfsmError(f"{path} holds no {MANIFEST}, so it is not a model folder")
    return _BUNDLE.read_manifest(path)
