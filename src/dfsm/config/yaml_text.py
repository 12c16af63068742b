"""YAML as plain values: texts, numbers, true and false, nothing, lists and keys.

A configuration needs no more. Dates, sets and other tags of YAML are texts or are refused, and what
takes long to read (deep nesting, aliases that multiply) is refused before it is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import (
    CollectionEndEvent,
    CollectionStartEvent,
    DocumentStartEvent,
    ScalarEvent,
)
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from dfsm.errors import DfsmError

# Far more than any configuration has; the reader takes seconds for so many.
MOST_CHARACTERS, MOST_VALUES, MOST_LEVELS = 1_000_000, 20_000, 40
# Whole numbers beyond are none that the arrays of a computation can hold.
_LARGEST = 2**63 - 1
_TAG = "tag:yaml.org,2002:"


def read_yaml(text: str) -> Any:
    """Read a YAML document.

    Parameters
    ----------
    text
        Its content.

    Returns
    -------
    Any
        Dictionaries, lists, str, int, float, bool and None.

    Raises
    ------
    DfsmError
        It is not valid, too large, or holds what no configuration needs; the line is told, and
        not the file.
    """
    if len(text) > MOST_CHARACTERS:
        raise DfsmError(
            f"{len(text)} characters are too many for a configuration, expected up to "
            f"{MOST_CHARACTERS}: check that it is the right file"
        )
    try:
        _check_size(text)
        node = YAML(typ="safe", pure=True).compose(text)
    except MarkedYAMLError as error:
        where = f"{_line(error.problem_mark)}: " if error.problem_mark else ""
        told = error.problem or error.context or "it breaks off"
        raise DfsmError(f"{where}not valid YAML ({told})") from None
    # The library's own slips on damaged text are no more of a user's concern than its errors.
    except (YAMLError, ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
        raise DfsmError(f"not valid YAML ({str(error).splitlines()[0][:120]})") from None
    return None if node is None else _Reader().value(node, 0)


def _check_size(text: str) -> None:
    """Refuse what would take long, as soon as that shows."""
    depth = count = 0
    for event in YAML(typ="safe", pure=True).parse(text):
        if isinstance(event, DocumentStartEvent) and count:
            return  # told by what reads it
        if isinstance(event, CollectionStartEvent):
            depth += 1
        elif isinstance(event, CollectionEndEvent):
            depth -= 1
        count += isinstance(event, ScalarEvent | CollectionStartEvent)
        if depth > MOST_LEVELS:
            raise _too_deep(event.start_mark)
        if count > MOST_VALUES:
            raise _too_many(event.start_mark)


class _Reader:
    """Turns nodes into values; counts them, because aliases may stand for many."""

    def __init__(self) -> None:
        self.count = 0
        # The library's own rules of how numbers are written.
        self.numbers = YAML(typ="safe", pure=True).constructor

    def value(self, node: Node, depth: int) -> Any:
        self.count += 1
        if self.count > MOST_VALUES:
            raise _too_many(node.start_mark)
        if depth > MOST_LEVELS:
            raise _too_deep(node.start_mark)
        tag = str(node.tag)
        if isinstance(node, MappingNode) and tag == f"{_TAG}map":
            return self.mapping(node, depth)
        if isinstance(node, SequenceNode) and tag == f"{_TAG}seq":
            return [self.value(child, depth + 1) for child in node.value]
        if isinstance(node, ScalarNode):
            return self.scalar(node, tag.removeprefix(_TAG))
        raise self.foreign(node)

    def mapping(self, node: MappingNode, depth: int) -> dict[Any, Any]:
        own: dict[Any, Any] = {}
        merged: dict[Any, Any] = {}
        before: Node | None = None
        for key_node, value_node in node.value:
            _check_decimal_comma(before, key_node, value_node)
            before = value_node
            if str(key_node.tag) == f"{_TAG}merge":
                for part in self.parts(value_node, depth):
                    merged = part | merged
                continue
            key = self.value(key_node, depth + 1)
            if not isinstance(key, str | int) or isinstance(key, bool):
                raise DfsmError(
                    f"{_line(key_node.start_mark)}: a key is {type(key).__name__}, expected a "
                    "name: write it in quotes"
                )
            if key in own:
                raise DfsmError(
                    f'{_line(key_node.start_mark)}: not valid YAML (found duplicate key "{key}"): '
                    "leave one out"
                )
            own[key] = self.value(value_node, depth + 1)
        return merged | own

    def parts(self, node: Node, depth: int) -> Iterator[dict[Any, Any]]:
        """The mappings that a key ``<<`` names, those that win first."""
        for part in node.value if isinstance(node, SequenceNode) else [node]:
            if not isinstance(part, MappingNode):
                raise DfsmError(
                    f"{_line(node.start_mark)}: '<<' is followed by no keys and values: name what "
                    "to merge as <<: *name"
                )
            yield self.value(part, depth + 1)

    def scalar(self, node: ScalarNode, kind: str) -> str | int | float | bool | None:
        text = str(node.value)
        try:
            if kind == "int":
                number = _LARGEST + 1 if len(text) > 100 else self.numbers.construct_yaml_int(node)
                if abs(number) > _LARGEST:
                    raise DfsmError(
                        f"{_line(node.start_mark)}: {text[:24]} is beyond {_LARGEST:.3g}, the "
                        "largest whole number: correct it, or write it as 1.0e+20"
                    )
                return int(number)
            if kind == "float":
                return float(self.numbers.construct_yaml_float(node))
            if kind == "bool":
                return bool(self.numbers.construct_yaml_bool(node))
        except (ValueError, KeyError, IndexError, OverflowError):
            raise DfsmError(
                f"{_line(node.start_mark)}: {text[:40]!r} is no number: correct it"
            ) from None
        if kind == "null":
            return None
        # A date is a text: no setting is one.
        if kind in ("str", "timestamp", "merge", "value"):
            return text
        raise self.foreign(node)

    def foreign(self, node: Node) -> DfsmError:
        return DfsmError(
            f"{_line(node.start_mark)}: not valid YAML (could not determine a constructor for the "
            f"tag {str(node.tag)[:60]!r}): a configuration has none, leave it out"
        )


def _check_decimal_comma(before: Node | None, key: Node, value: Node) -> None:
    """Refuse ``{weight: 1,5}``, which YAML takes for a weight of 1 and a key 5."""
    texts = [n.value for n in (before, key, value) if isinstance(n, ScalarNode)]
    if (
        len(texts) == 3
        and before is not None
        and str(before.tag) == f"{_TAG}int"
        and str(key.tag) in (f"{_TAG}int", f"{_TAG}float")
        and not texts[2]
        and key.start_mark.index == before.end_mark.index + 1
    ):
        raise DfsmError(
            f"{_line(key.start_mark)}: {texts[0]},{texts[1]} has a decimal comma, which parts keys "
            f"here: write {texts[0]}.{texts[1]}"
        )


def _too_deep(mark: Any) -> DfsmError:
    return DfsmError(
        f"{_line(mark)}: nested too deeply for a configuration, more than {MOST_LEVELS} levels"
    )


def _too_many(mark: Any) -> DfsmError:
    return DfsmError(
        f"{_line(mark)}: more than {MOST_VALUES} values, aliases counted as what they stand for, "
        "which are too many for a configuration"
    )


def _line(mark: Any) -> str:
    return "line ?" if mark is None else f"line {mark.line + 1}"
