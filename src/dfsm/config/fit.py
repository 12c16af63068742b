"""`config.yaml`: which files, which signals, which settings; checked before any work starts."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, PrivateAttr, ValidationError, field_validator

from dfsm.config.parse import Strict, check_truths, explain, load_yaml, parse_file
from dfsm.core.settings import require
from dfsm.data.between import Between
from dfsm.data.derivatives import DerivativeSettings, StateSpec, state_names
from dfsm.data.features import Feature
from dfsm.data.hold_out import HoldOut, checked
from dfsm.data.parameters import Table, names_in, read_parameters, with_parameters
from dfsm.data.readers import read_all
from dfsm.data.slower import Slower
from dfsm.data.suspects import Suspects
from dfsm.data.trajectory import Trajectory
from dfsm.errors import DfsmError
from dfsm.fitting.corrective import MLP, CorrectiveSettings
from dfsm.fitting.hidden.settings import HiddenSettings
from dfsm.fitting.linear import LPV, LTI
from dfsm.fitting.samples import only_read
from dfsm.fitting.settings import FitSettings
from dfsm.models.signals import Azimuth
from dfsm.models.terms import Rotor, TermSettings
from dfsm.refinement.settings import RefineSettings
from dfsm.selection.compare import HOLD_OUT, check_candidates
from dfsm.selection.trial import Candidate

# Name of the configuration itself among the candidates of `compare`.
BASE = "base"
_CANDIDATES = "compare.candidates"
_ADVICE = "make one with dfsm init"
_VALUES = "its value in every run, as {run1.outb: 1.0}"
_PARAMETERS = (
    "a list of channels, values of runs as {Ballast: {run1.outb: 1.0}}, or the name of a CSV table"
)


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
    step
        Interval between samples in s of files that hold no time.
    slower
        What channels with fewer samples than their table do in between: hold or linear, or by name.
    outliers
        What to do with samples and runs that cannot belong to the rest, see `screened`.
    """

    train: list[str]
    start: float | None = None
    stop: float | None = None
    hub_height: float | None = None
    step: float | None = None
    slower: Slower = None
    outliers: Suspects = FitSettings.outliers


class SignalConfig(Strict):
    """Channel names by role, see `FitSettings`.

    Parameters that the files do not hold may stand here: ``{Ballast: {run1.outb: 1.0, …}}``, or
    the name of a CSV table, see `read_parameters`.
    """

    states: list[StateSpec]
    controls: list[str] = Field(default_factory=list)
    disturbances: list[str] = Field(default_factory=list)
    features: list[Feature] = Field(default_factory=list)
    parameters: list[str] | dict[str, dict[str, float]] | str = Field(default_factory=list)
    outputs: list[str] = Field(default_factory=list)

    @field_validator("parameters", mode="before")
    @classmethod
    def _one_of_three(cls, value: object) -> object:
        """Say in one sentence what none of the three forms can be."""
        where = "'signals.parameters'"
        if isinstance(value, Mapping):
            for name, values in value.items():
                require(_numbers(values), f"{where}: '{name}'", values, _VALUES)
        elif not isinstance(value, str):
            names = isinstance(value, list) and all(isinstance(n, str) for n in value)
            require(names, where, value, _PARAMETERS)
        return value


def _numbers(values: object) -> bool:
    if not (isinstance(values, Mapping) and values):
        return False
    return all(isinstance(v, int | float) and not isinstance(v, bool) for v in values.values())


class CompareConfig(Strict):
    """What `dfsm compare` compares; `dfsm fit` does not look at it.

    Attributes
    ----------
    candidates
        By name the keys that each of them changes; the configuration itself is called base.
    hold_out
        Share of the training runs that rank the candidates, or a `HoldOut` of one split.
    validation
        Files that rank them instead; those among the training files are not trained with.
    """

    candidates: dict[str, dict[str, Any]] = Field(default_factory=dict)
    hold_out: float | HoldOut = HOLD_OUT
    validation: list[str] | None = None

    def model_post_init(self, _: Any, /) -> None:
        """Check what types cannot."""
        checked(self.hold_out, "compare.hold_out")
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
    terms: list[Annotated[TermSettings, Field(discriminator="kind")]] = Field(default_factory=list)
    corrective: Annotated[CorrectiveSettings, Field(discriminator="kind")] = MLP()
    gate: float = FitSettings.gate
    corrected: tuple[str, ...] | None = FitSettings.corrected
    azimuth: Azimuth | None = None
    inputs: Between | dict[str, Between] | None = None
    nonlinear_only: bool = FitSettings.nonlinear_only
    refine: RefineSettings | None = None
    hidden: HiddenSettings | None = None
    seed: int = FitSettings.seed
    compare: CompareConfig = CompareConfig()
    _folder: Path = PrivateAttr(default=Path())

    def at(self, folder: Path) -> Config:
        """The same configuration, whose files are named from a folder."""
        self._folder = folder
        return self

    def fit_settings(self) -> FitSettings:
        """The settings of `fit`."""
        s = self.signals
        return FitSettings(
            states=tuple(s.states),
            controls=tuple(s.controls),
            disturbances=tuple(s.disturbances),
            features=tuple(s.features),
            parameters=self.parameter_names,
            outputs=tuple(s.outputs),
            start=self.data.start,
            stop=self.data.stop,
            hub_height=self.data.hub_height,
            slower=self.data.slower,
            outliers=self.data.outliers,
            derivatives=self.derivatives,
            linear=self.linear,
            terms=tuple(self._rooted(term) for term in self.terms),
            corrective=self.corrective,
            gate=self.gate,
            corrected=self.corrected,
            azimuth=self.azimuth,
            inputs=self.inputs,
            nonlinear_only=self.nonlinear_only,
            seed=self.seed,
            hidden=self.hidden,
        )

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the plant parameters, wherever their values stand."""
        given = self.signals.parameters
        return tuple(given if isinstance(given, list) else names_in(self._parameters()))

    def kept(self, run: Trajectory) -> Trajectory:
        """A run without the channels that a fit never reads."""
        return only_read(run, self.fit_settings(), elsewhere=names_in(self._parameters()))

    def with_parameters(self, runs: Sequence[Trajectory]) -> list[Trajectory]:
        """Runs with the parameters that the configuration gives."""
        return with_parameters(runs, self._parameters())

    def _parameters(self) -> Table:
        given = self.signals.parameters
        if isinstance(given, str):
            return read_parameters(self._folder / given)
        return {} if isinstance(given, list) else given

    def _rooted(self, term: TermSettings) -> TermSettings:
        if isinstance(term, Rotor) and isinstance(term.table, str | Path):
            return replace(term, table=self._folder / term.table)
        return term


def load_config(path: str | Path, *, whole: bool = True) -> tuple[Config, list[Trajectory]]:
    """Read a configuration and the training runs that it names.

    Parameters
    ----------
    path
        The configuration.
    whole
        Keep all channels of the runs; otherwise those that its fit reads, see `only_read`.

    Raises
    ------
    DfsmError
        The file is missing or not YAML, a key is unknown or has a wrong type (its path is
        told), or a pattern matches no file.
    """
    path = Path(path)
    config = parse_config(path)
    _require_files(config, path)
    try:
        _check_together(config)
    except DfsmError as error:
        raise DfsmError(f"{path}: {error}") from None
    keep = None if whole else config.kept
    runs = read_all(config.data.train, path.parent, config.data.step, keep)
    return config, config.with_parameters(runs)


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
    raw = load_yaml(path, _ADVICE)
    try:
        _check_together(config)
        candidates = {
            BASE: Candidate(config.fit_settings(), config.refine, f"{path.name} as it stands")
        }
        for name, changes in config.compare.candidates.items():
            candidates[name] = _candidate(raw, name, changes, path.parent)
        check_candidates(candidates)
    except DfsmError as error:
        raise DfsmError(f"{path}: {error}") from None
    return config, candidates


def _candidate(
    raw: Mapping[str, Any], name: str, changes: Mapping[str, Any], folder: Path
) -> Candidate:
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
        check_truths(merged, Config)
        config = Config.model_validate(merged).at(folder)
        _check_together(config)
    except ValidationError as error:
        raise DfsmError(explain(error, merged, Config, f"{where}.")) from None
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
    """Path and value of every key that a candidate changes."""
    pairs = []
    for key, value in changes.items():
        if isinstance(value, Mapping) and value:
            pairs += _changed(value, f"{prefix}{key}.")
        else:
            text = value if isinstance(value, str) else None
            shown = text or json.dumps(value, ensure_ascii=False, default=str)
            pairs.append((f"{prefix}{key}", shown))
    return pairs


def _require_files(config: Config, path: Path) -> None:
    if not config.data.train:
        raise DfsmError(f"{path}: 'data.train' names no files: list the runs to train with")


def _check_together(config: Config) -> None:
    """What only shows with all keys together must not wait until the data have been read."""
    _ = state_names(config.signals.states), config.fit_settings().roles


def parse_config(path: Path) -> Config:
    """Read and check a configuration without touching the data."""
    return parse_file(path, Config, _ADVICE).at(path.parent)
