"""What an FMU says of itself: modelDescription.xml of FMI 2.0 and 3.0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from xml.etree import ElementTree

from dfsm.core.version import __version__

Element = ElementTree.Element


@dataclass(frozen=True)
class Variable:
    """A variable of an FMU.

    Attributes
    ----------
    name, unit
        As importers show them.
    start
        Value at first; None for what is computed.
    role
        ``"independent"``, ``"state"``, ``"derivative"``, ``"input"``, ``"parameter"`` or
        ``"output"``.
    note
        What else is to be said of it.
    reference
        Value reference.
    derivative_of
        Value reference of the state whose derivative it is.
    moves
        Whether it is an input that goes on between samples: an importer may set it within a step.
    """

    name: str
    unit: str
    start: float | None
    role: str
    note: str
    reference: int
    derivative_of: int | None = None
    moves: bool = False


# Causality, variability and initial of every role.
_ROLES = {
    "independent": ("independent", "continuous", None),
    "state": ("local", "continuous", "exact"),
    "derivative": ("local", "continuous", "calculated"),
    "input": ("input", "continuous", None),
    "parameter": ("parameter", "fixed", "exact"),
    "output": ("output", "continuous", "calculated"),
}


def model_description(
    name: str,
    token: str,
    fmi: int,
    kinds: Sequence[str],
    variables: Sequence[Variable],
    step: float,
) -> bytes:
    """The XML of an FMU.

    Parameters
    ----------
    name
        Of the model, an identifier of C.
    token
        Told again at instantiation.
    fmi
        2 or 3.
    kinds
        Interfaces that it has.
    variables
        In the order of their value references.
    step
        Communication step in s that an importer is to take unless it is told another.
    """
    if "co-simulation" not in kinds:  # nobody else has steps to set inputs within
        variables = [replace(v, moves=False) for v in variables]
    about = {
        "fmiVersion": f"{fmi}.0",
        "modelName": name,
        "guid" if fmi == 2 else "instantiationToken": token,
        "generationTool": f"dfsm {__version__}",
        "variableNamingConvention": "flat",
    }
    if fmi == 2:
        about["numberOfEventIndicators"] = "0"
    root = Element("fmiModelDescription", about)
    for kind in kinds:
        _interface(root, name, fmi, kind, moving=any(v.moves for v in variables))
    units = ElementTree.SubElement(root, "UnitDefinitions")
    for unit in sorted({v.unit for v in variables if v.unit}):
        ElementTree.SubElement(units, "Unit", {"name": unit})
    ElementTree.SubElement(
        root, "DefaultExperiment", {"startTime": "0", "stepSize": repr(float(step))}
    )
    listed = ElementTree.SubElement(root, "ModelVariables")
    for variable in variables:
        (_variable2 if fmi == 2 else _variable3)(listed, variable)
    (_structure2 if fmi == 2 else _structure3)(root, variables)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def build_description(name: str) -> bytes:
    """How an FMU of FMI 3.0 is compiled from its sources."""
    root = Element("fmiBuildDescription", {"fmiVersion": "3.0"})
    build = ElementTree.SubElement(root, "BuildConfiguration", {"modelIdentifier": name})
    files = ElementTree.SubElement(build, "SourceFileSet", {"language": "C99"})
    for file in (f"{name}.c", "fmu.c"):
        ElementTree.SubElement(files, "SourceFile", {"name": file})
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def _interface(root: Element, name: str, fmi: int, kind: str, *, moving: bool) -> None:
    state = "FMUstate" if fmi == 2 else "FMUState"
    can = {"modelIdentifier": name, f"canGetAndSet{state}": "true"}
    can |= {f"canSerialize{state}": "true"}
    tag = "ModelExchange"
    if kind == "co-simulation":
        tag, can["canHandleVariableCommunicationStepSize"] = "CoSimulation", "true"
        if fmi == 2:
            can["canInterpolateInputs"] = "true"
        elif moving:
            can["providesIntermediateUpdate"] = "true"
    element = ElementTree.SubElement(root, tag, can)
    if fmi == 2:
        files = ElementTree.SubElement(element, "SourceFiles")
        for file in (f"{name}.c", "fmu.c"):
            ElementTree.SubElement(files, "File", {"name": file})


def _common(variable: Variable) -> dict[str, str]:
    causality, variability, initial = _ROLES[variable.role]
    told = {"name": variable.name, "valueReference": str(variable.reference)}
    if variable.note:
        told["description"] = variable.note
    told |= {"causality": causality, "variability": variability}
    return told | ({"initial": initial} if initial is not None else {})


def _numbers(variable: Variable) -> dict[str, str]:
    told = {"unit": variable.unit} if variable.unit else {}
    if variable.start is not None and variable.role != "independent":
        told["start"] = repr(float(variable.start))
    return told


def _variable2(listed: Element, variable: Variable) -> None:
    element = ElementTree.SubElement(listed, "ScalarVariable", _common(variable))
    numbers = _numbers(variable)
    if variable.derivative_of is not None:
        # By place in the list, from 1.
        numbers["derivative"] = str(variable.derivative_of + 1)
    ElementTree.SubElement(element, "Real", numbers)


def _variable3(listed: Element, variable: Variable) -> None:
    told = _common(variable) | _numbers(variable)
    if variable.derivative_of is not None:
        told["derivative"] = str(variable.derivative_of)
    if variable.moves:
        told["intermediateUpdate"] = "true"
    ElementTree.SubElement(listed, "Float64", told)


def _structure2(root: Element, variables: Sequence[Variable]) -> None:
    structure = ElementTree.SubElement(root, "ModelStructure")
    for tag, roles in (
        ("Outputs", ("output",)),
        ("Derivatives", ("derivative",)),
        ("InitialUnknowns", ("derivative", "output")),
    ):
        unknown = [v for v in variables if v.role in roles]
        part = ElementTree.SubElement(structure, tag) if unknown else None
        for variable in unknown:
            if part is not None:
                index = {"index": str(variable.reference + 1)}
                ElementTree.SubElement(part, "Unknown", index)


def _structure3(root: Element, variables: Sequence[Variable]) -> None:
    structure = ElementTree.SubElement(root, "ModelStructure")
    for tag, roles in (
        ("Output", ("output",)),
        ("ContinuousStateDerivative", ("derivative",)),
        ("InitialUnknown", ("derivative", "output")),
    ):
        for variable in variables:
            if variable.role in roles:
                told = {"valueReference": str(variable.reference)}
                ElementTree.SubElement(structure, tag, told)
