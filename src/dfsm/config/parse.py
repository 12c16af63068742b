"""YAML files as checked settings; whatever is wrong with one is told in one sentence."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from dfsm.config.yaml_text import read_yaml
from dfsm.data.readers.text import decode
from dfsm.errors import DfsmError, near_matches

Parsed = TypeVar("Parsed", bound=BaseModel)
_COMMA = re.compile(r"[-+]?\d+,\d+")
_Keys = tuple[int | str, ...]
# Where Latin-1 has control characters, Windows has dashes and quotation marks.
_WINDOWS = {code: bytes([code]).decode("cp1252", "replace") for code in range(0x80, 0xA0)}


class Strict(BaseModel):
    """Frozen, and unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


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
    raw = load_yaml(path, advice)
    try:
        check_truths(raw, kind)
        return kind.model_validate(raw)
    except ValidationError as error:
        raise DfsmError(f"{path}: {explain(error, raw, kind)}") from None
    except DfsmError as error:
        raise DfsmError(f"{path}: {error}") from None


def load_yaml(path: Path, advice: str) -> dict[str, Any]:
    """Mapping that a YAML file holds; `advice` says what to do without such a file."""
    if path.is_dir():
        inside = [*path.glob("config.yaml")] or [*path.glob("*.yaml"), *path.glob("*.yml")]
        hint = f"did you mean {inside[0]}?" if len(inside) == 1 else f"name one, or {advice}"
        raise DfsmError(f"{path} is a folder, a configuration file was expected: {hint}")
    try:
        # Editors of Windows save a comment with an umlaut in letters of its own, or as UTF-16.
        text = decode(path, "a configuration").translate(_WINDOWS)
    except DfsmError:
        raise DfsmError(f"{path} is not valid YAML (it is no text): {advice}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None)
        if reason is None:
            raise DfsmError(f"{path} is not valid YAML ({error})") from None
        raise DfsmError(f"{path} cannot be read ({reason}): {advice}") from None
    try:
        raw = read_yaml(text)
    except DfsmError as error:
        joint = "," if str(error).startswith("line") else ":"
        raise DfsmError(f"{path}{joint} {error}") from None
    if not isinstance(raw, dict):
        raise DfsmError(f"{path} holds no keys; {advice}")
    return raw


def check_truths(raw: Any, kind: type[BaseModel]) -> None:
    """Refuse true and false where a number is expected: taken for 1 and 0 they say something else.

    Raises
    ------
    DfsmError
        The path of the key as it stands in the file.
    """
    schema = kind.model_json_schema()
    for keys, value in _truths(raw, ()):
        types = [node.get("type", "boolean") for node in _schemas(keys, schema)]
        if "boolean" not in types and {"number", "integer"} & set(types):
            raise DfsmError(f"'{_written(keys)}': a number was expected, not {str(value).lower()}")


def _truths(node: Any, keys: _Keys) -> Iterator[tuple[_Keys, bool]]:
    """Every true and false with the path of its key."""
    if isinstance(node, bool):
        yield keys, node
    elif isinstance(node, dict):
        for key, value in node.items():
            yield from _truths(value, (*keys, key))
    elif isinstance(node, list):
        for place, value in enumerate(node):
            yield from _truths(value, (*keys, place))


def _written(keys: Sequence[int | str]) -> str:
    return "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in keys).lstrip(".")


def explain(
    error: ValidationError, raw: dict[str, Any], kind: type[BaseModel], prefix: str = ""
) -> str:
    """The first thing wrong, with the path of its key as it stands in the file."""
    first = error.errors()[0]
    if first["type"] == "value_error":
        # Raised by a settings class itself, already one sentence.
        return str(first.get("ctx", {}).get("error", first["msg"]))
    lost = first["type"] in ("missing", "missing_argument", "missing_keyword_only_argument")
    keys = _path(first["loc"], raw) if lost else _place(first["loc"], raw)
    where = prefix + _written(keys)
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        known = _known_keys(keys[:-1], raw, kind)
        return f"unknown key '{where}'; {near_matches(str(keys[-1]), known)}"
    if lost:
        return f"key '{where}' is missing"
    if first["type"].startswith("union_tag"):
        kinds = ", ".join(f"'{k}'" for k in _kinds(keys, kind))
        named = first["input"].get("kind") if isinstance(first["input"], dict) else None
        if named is None:
            return f"'{where}' needs a key 'kind', one of {kinds}"
        hint = near_matches(str(named), _kinds(keys, kind))
        return f"'{where}.kind' is '{named}', expected one of {kinds}; {hint}"
    value = f", not {first['input']!r}" if not isinstance(first["input"], dict | list) else ""
    if isinstance(first["input"], str) and _COMMA.fullmatch(first["input"].strip()):
        value += ", which has a decimal comma: write a point"
    message = _MESSAGES.get(first["type"], first["msg"])
    return f"'{where}': {message[0].lower()}{message[1:]}{value}"


def _place(loc: tuple[int | str, ...], raw: Any) -> list[int | str]:
    """Path of a key that is there, without names of union members, its last one included."""
    node, keys = raw, list[int | str]()
    for key in loc:
        try:
            node = node[key]
        except (KeyError, IndexError, TypeError):
            continue
        keys.append(key)
    return keys


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
    nodes = _schemas(keys, kind.model_json_schema())
    for key in keys:
        raw = raw[key]
    kinds = [n for n in nodes if _kind(n) == raw.get("kind")]
    return list(dict.fromkeys(k for node in kinds or nodes for k in node.get("properties", {})))


def _kinds(keys: list[int | str], kind: type[BaseModel]) -> list[str]:
    """Values that the key 'kind' may have at a path."""
    return [name for node in _schemas(keys, kind.model_json_schema()) if (name := _kind(node))]


def _kind(node: dict[str, Any]) -> str | None:
    return node.get("properties", {}).get("kind", {}).get("const")


def _schemas(keys: Sequence[int | str], schema: dict[str, Any]) -> list[dict[str, Any]]:
    """What may stand at a path, from the JSON schema of the configuration."""
    nodes = [schema]
    for key in keys:
        nodes = [child for node in nodes for child in _children(schema, node, key)]
    return nodes


def _children(schema: dict[str, Any], node: dict[str, Any], key: int | str) -> list[dict[str, Any]]:
    if isinstance(key, int):
        places = node.get("prefixItems", [])
        child = places[key] if key < len(places) else node.get("items")
    else:
        child = node.get("properties", {}).get(key)
    if child is None:
        child = node.get("additionalProperties")
    if not isinstance(child, dict):
        return []
    return list(_options(schema, child))


def _options(schema: dict[str, Any], node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """What a node may be, where it may be one of several things, of which each may be."""
    reference = node.get("$ref")
    node = schema["$defs"][reference.rsplit("/", 1)[-1]] if reference else node
    several = node.get("oneOf") or node.get("anyOf")
    if several is None:
        yield node
    for option in several or ():
        yield from _options(schema, option)
