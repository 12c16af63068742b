"""`config.yaml`: which files, which signals, which settings; checked before any work starts."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from dfsm.compare import HOLD_OUT, check_candidates
from dfsm.corrective import GP, MLP, RBF, IncrementalRBF, NoCorrection
from dfsm.derivatives import DerivativeSettings, StateSpec, state_names
from dfsm.errors import DfsmError, near_matches
from dfsm.features import Feature
from dfsm.linear import LPV, LTI
from dfsm.read import read_all
from dfsm.refine import RefineSettings
from dfsm.samples import FitSettings
from dfsm.settings import require
from dfsm.signals import Azimuth
from dfsm.trajectory import Trajectory
from dfsm.trial import Candidate

# Name of the configuration itself among the candidates of `compare`.
BASE = "base"
_CANDIDATES = "compare.candidates"
_ADVICE = "make one with dfsm init"

Parsed = TypeVar("Parsed", bound=BaseModel)


class Strict(BaseModel):
    """Frozen, and unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class DataConfig(Strict):
    """Training files and the part of them that is used.

    Attributes
    ----------
    train
        File names or patterns, relative to the configuration file.
    start, stop
        Time window in s; null leaves that end open.
    hub_height
        In m; adds the corrected rotor wind ``RtVAvgxhCorr`` to every run.
    """

    train: list[str]
    start: float | None = None
    stop: float | None = None
    hub_height: float | None = None


class SignalConfig(Strict):
    """Channel names by role, see `FitSettings`."""

    states: list[StateSpec]
    controls: list[str] = []
    disturbances: list[str] = []
    features: list[Feature] = []
    parameters: list[str] = []
    outputs: list[str] = []


class CompareConfig(Strict):
    """What `dfsm compare` compares; `dfsm fit` does not look at it.

    Attributes
    ----------
    candidates
        By name the keys that each of them changes; the configuration itself is called base.
    hold_out
        Share of the training runs that rank the candidates.
    validation
        Files that rank them instead; those among the training files are not trained with.
    """

    candidates: dict[str, dict[str, Any]] = {}
    hold_out: float = HOLD_OUT
    validation: list[str] | None = None

    def model_post_init(self, _: Any, /) -> None:
        """Check what types cannot."""
        share = "a share between 0 and 1"
        require(0 < self.hold_out < 1, "compare.hold_out", self.hold_out, share)
        both = self.validation is not None and "hold_out" in self.model_fields_set
        require(not both, "compare.hold_out", self.hold_out, "no value beside compare.validation")
        files = self.validation is None or bool(self.validation)
        require(files, "compare.validation", "empty", "file names or patterns, or null")


class Config(Strict):
    """A whole `config.yaml`."""

    data: DataConfig
    signals: SignalConfig
    derivatives: DerivativeSettings = DerivativeSettings()
    linear: Annotated[LTI | LPV, Field(discriminator="kind")] = LTI()
    corrective: Annotated[
        RBF | IncrementalRBF | GP | MLP | NoCorrection, Field(discriminator="kind")
    ] = MLP()
    gate: float = FitSettings.gate
    azimuth: Azimuth | None = None
    nonlinear_only: bool = FitSettings.nonlinear_only
    refine: RefineSettings | None = None
    seed: int = FitSettings.seed
    compare: CompareConfig = CompareConfig()

    def fit_settings(self) -> FitSettings:
        """The settings of `fit`."""
        s = self.signals
        return FitSettings(
            states=tuple(s.states),
            controls=tuple(s.controls),
            disturbances=tuple(s.disturbances),
            features=tuple(s.features),
            parameters=tuple(s.parameters),
            outputs=tuple(s.outputs),
            start=self.data.start,
            stop=self.data.stop,
            hub_height=self.data.hub_height,
            derivatives=self.derivatives,
            linear=self.linear,
            corrective=self.corrective,
            gate=self.gate,
            azimuth=self.azimuth,
            nonlinear_only=self.nonlinear_only,
            seed=self.seed,
        )


def load_config(path: str | Path) -> tuple[Config, list[Trajectory]]:
    """Read a configuration and the training runs that it names.

    Raises
    ------
    DfsmError
        The file is missing or not YAML, a key is unknown or has a wrong type (its path is
        given), or a pattern matches no file.
    """
    path = Path(path)
    config = parse_config(path)
    _require_files(config, path)
    try:
        _check_together(config)
    except DfsmError as error:
        raise DfsmError(f"{path}: {error}") from None
    return config, read_all(config.data.train, path.parent)


def parse_candidates(path: str | Path) -> tuple[Config, dict[str, Candidate]]:
    """Read a configuration and the candidates that it declares, without touching the data.

    Returns
    -------
    tuple
        The configuration, and the candidates by name: itself first, as ``base``.

    Raises
    ------
    DfsmError
        As `load_config`; also without candidates, or where one has an unknown key or value.
    """
    path = Path(path)
    config = parse_config(path)
    _require_files(config, path)
    if not config.compare.candidates:
        raise DfsmError(
            f"{path}: '{_CANDIDATES}' is missing: name what to try there, for instance "
            "compare: {candidates: {gp: {corrective: {kind: gp}}}}"
        )
    raw = _load_yaml(path, _ADVICE)
    try:
        _check_together(config)
        found = {BASE: Candidate(config.fit_settings(), config.refine, f"{path.name} as it stands")}
        for name, changes in config.compare.candidates.items():
            found[name] = _candidate(raw, name, changes)
        check_candidates(found)
    except DfsmError as error:
        raise DfsmError(f"{path}: {error}") from None
    return config, found


def _candidate(raw: Mapping[str, Any], name: str, changes: Mapping[str, Any]) -> Candidate:
    where = f"{_CANDIDATES}.{name}"
    if name == BASE:
        raise DfsmError(f"'{where}' is the configuration itself: choose another name")
    for key in ("data", "compare"):
        if key in changes:
            raise DfsmError(
                f"'{where}.{key}' cannot be changed, candidates are compared on the same runs: "
                f"change '{key}' for all of them"
            )
    merged = _merged(raw, changes)
    try:
        config = Config.model_validate(merged)
        _check_together(config)
    except ValidationError as error:
        raise DfsmError(_explain(error, merged, Config, f"{where}.")) from None
    except DfsmError as error:
        raise DfsmError(f"{where}: {error}") from None
    told = (f"{k} = {v}" for k, v in _changed(changes))
    return Candidate(config.fit_settings(), config.refine, "; ".join(told))


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with some keys changed; what is of another kind has other keys and is replaced."""
    merged = dict(base)
    for key, value in changes.items():
        old = base.get(key)
        merged[key] = value
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            kind = old.get("kind")
            if value.get("kind", kind) == kind:
                merged[key] = _merged(old, value)
    return merged


def _changed(changes: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Path and value of every key that a candidate gives."""
    found = []
    for key, value in changes.items():
        if isinstance(value, Mapping) and value:
            found += _changed(value, f"{prefix}{key}.")
        else:
            text = value if isinstance(value, str) else None
            shown = text or json.dumps(value, ensure_ascii=False, default=str)
            found.append((f"{prefix}{key}", shown))
    return found


def _require_files(config: Config, path: Path) -> None:
    if not config.data.train:
        raise DfsmError(f"{path}: 'data.train' names no files: list the runs to train with")


def _check_together(config: Config) -> None:
    """What only shows with all keys together must not wait until the data have been read."""
    _ = state_names(config.signals.states), config.fit_settings().roles


def parse_config(path: Path) -> Config:
    """Read and check a configuration without touching the data."""
    return parse_file(path, Config, _ADVICE)


def parse_file(path: Path, kind: type[Parsed], advice: str) -> Parsed:
    """Read a YAML file as a pydantic model; whatever is wrong with it is one sentence.

    Parameters
    ----------
    path
        File to read.
    kind
        Model that says which keys there are.
    advice
        What to do without such a file.

    Raises
    ------
    DfsmError
        The file is missing or not YAML, or a key is unknown, missing or wrong.
    """
    raw = _load_yaml(path, advice)
    try:
        return kind.model_validate(raw)
    except ValidationError as error:
        raise DfsmError(f"{path}: {_explain(error, raw, kind)}") from None
    except DfsmError as error:
        raise DfsmError(f"{path}: {error}") from None


def _load_yaml(path: Path, advice: str) -> dict[str, Any]:
    if path.is_dir():
        inside = [*path.glob("config.yaml")] or [*path.glob("*.yaml"), *path.glob("*.yml")]
        hint = f"did you mean {inside[0]}?" if len(inside) == 1 else f"name one, or {advice}"
        raise DfsmError(f"{path} is a folder, a configuration file was expected: {hint}")
    try:
        raw = YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DfsmError(f"{path} cannot be read ({error.strerror}): {advice}") from None
    except MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else "?"
        raise DfsmError(f"{path}, line {line}: not valid YAML ({error.problem})") from None
    except (YAMLError, UnicodeDecodeError) as error:
        raise DfsmError(f"{path} is not valid YAML ({str(error).splitlines()[0]})") from None
    except RecursionError:
        raise DfsmError(f"{path} is nested too deeply for a configuration") from None
    if not isinstance(raw, dict):
        raise DfsmError(f"{path} holds no keys; {advice}")
    return raw


def _explain(
    error: ValidationError, raw: dict[str, Any], kind: type[BaseModel], prefix: str = ""
) -> str:
    """The first thing wrong, with the path of its key as it stands in the file."""
    first = error.errors()[0]
    if first["type"] == "value_error":
        # Raised by a settings class itself, already one sentence.
        return str(first.get("ctx", {}).get("error", first["msg"]))
    keys = _path(first["loc"], raw)
    where = "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in keys).lstrip(".")
    where = prefix + where
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        known = _known_keys(keys[:-1], raw, kind)
        return f"unknown key '{where}'; {near_matches(str(keys[-1]), known)}"
    if first["type"] in ("missing", "missing_argument", "missing_keyword_only_argument"):
        return f"key '{where}' is missing"
    if first["type"].startswith("union_tag"):
        kinds = ", ".join(f"'{k}'" for k in _kinds(keys, kind))
        given = first["input"].get("kind") if isinstance(first["input"], dict) else None
        if given is None:
            return f"'{where}' needs a key 'kind', one of {kinds}"
        hint = near_matches(str(given), _kinds(keys, kind))
        return f"'{where}.kind' is '{given}', expected one of {kinds}; {hint}"
    found = f", not {first['input']!r}" if not isinstance(first["input"], dict | list) else ""
    message = _MESSAGES.get(first["type"], first["msg"])
    return f"'{where}': {message[0].lower()}{message[1:]}{found}"


# Where pydantic speaks of Python, in the words of a configuration file.
_KEYS, _LIST = "keys and values were expected, as {key: value}", "a list was expected, as [a, b]"
_MESSAGES: dict[str, str] = {
    "model_type": _KEYS,
    "model_attributes_type": _KEYS,
    "dataclass_type": _KEYS,
    "dict_type": _KEYS,
    "list_type": _LIST,
    "tuple_type": _LIST,
}


def _path(loc: tuple[int | str, ...], raw: Any) -> list[int | str]:
    """Drop the names of union members that pydantic puts between the keys of the file."""
    keys: list[int | str] = []
    node: Any = raw
    for i, key in enumerate(loc):
        try:
            node = node[key]
        except (KeyError, IndexError, TypeError):
            # The last key may be missing from the file, or be wrong; others are pydantic's own.
            if i < len(loc) - 1:
                continue
        keys.append(key)
    return keys


def _known_keys(keys: list[int | str], raw: Any, kind: type[BaseModel]) -> list[str]:
    """Keys that may stand at a path, from the JSON schema of the configuration."""
    nodes = _schemas(keys, kind)
    for key in keys:
        raw = raw[key]
    kinds = [n for n in nodes if _kind(n) == raw.get("kind")]
    return list(dict.fromkeys(k for node in kinds or nodes for k in node.get("properties", {})))


def _kinds(keys: list[int | str], kind: type[BaseModel]) -> list[str]:
    """Values that the key 'kind' may have at a path."""
    return [found for node in _schemas(keys, kind) if (found := _kind(node))]


def _kind(node: dict[str, Any]) -> str | None:
    return node.get("properties", {}).get("kind", {}).get("const")


def _schemas(keys: list[int | str], kind: type[BaseModel]) -> list[dict[str, Any]]:
    schema = kind.model_json_schema()
    nodes = [schema]
    for key in keys:
        nodes = [child for node in nodes for child in _children(schema, node, key)]
    return nodes


def _children(schema: dict[str, Any], node: dict[str, Any], key: int | str) -> list[dict[str, Any]]:
    child = node.get("items") if isinstance(key, int) else node.get("properties", {}).get(key)
    if child is None:
        child = node.get("additionalProperties")
    if not isinstance(child, dict):
        return []
    options = child.get("oneOf") or child.get("anyOf") or [child]
    resolved = [_resolve(schema, o) for o in options]
    return [r for r in resolved if isinstance(r, dict)]


def _resolve(schema: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    reference = node.get("$ref")
    return schema["$defs"][reference.rsplit("/", 1)[-1]] if reference else node
