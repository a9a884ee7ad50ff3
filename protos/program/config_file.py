"""Reads strict YAML: no key twice, and every problem as one line that names file, key and expectation.

Both planes read their configuration with it. Its cost is bounded: aliases do not multiply, and no number is endless.
"""

from __future__ import annotations

import difflib
import re
from typing import TYPE_CHECKING, Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from plr.protos.base.errors import ConfigError
from plr.protos.program.regular_file import read_regular

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from pydantic_core import ErrorDetails

Model = TypeVar("Model", bound=BaseModel)

MAX_CONFIG_BYTES = 1 << 20
"""A configuration is written by hand; a larger file is something else."""

MAX_VALUES = 100_000
"""Values in one file; those that an alias repeats count each time."""

_MAX_WHOLE = (1 << 63) - 1
_MAX_NUMBER_CHARACTERS = 64

_SHOWN_INPUT_CHARACTERS = 60
_MAX_PROBLEM_CHARACTERS = 400
"""A line that quotes what was written stays readable whatever that is."""
_EXPONENT = re.compile(r"[+-]?\d+(\.\d*)?[eE]\d+")

_UNQUOTED = re.compile(r"(^|[:,\[{-])\s*(\*|\[[0-9A-Fa-f:]*\]:)")
"""An address such as [::]:50051, or a pattern such as *, which YAML takes for a list or an alias."""

_EXPECTED = {
    "tuple_type": "a list",
    "model_type": "keys and values",
    "string_type": "text",
    "int_type": "a whole number",
    "float_type": "a number",
    "bool_type": "true or false",
    "path_type": "a path",
}
"""Names of the kinds of values for the reader of a YAML file."""


class _StrictLoader(yaml.SafeLoader):
    """SafeLoader that refuses excessive input, and a key written twice, of which YAML would silently keep the last."""

    def get_single_data(self) -> Any:
        node = self.get_single_node()
        if node is None:
            return None
        _count(node, {})
        return self.construct_document(node)

    def whole_number(self, node: yaml.ScalarNode) -> int:
        _refuse_long(node)
        _refuse_ambiguous(node)
        value = self.construct_yaml_int(node)
        if abs(value) > _MAX_WHOLE:
            raise _refused("no number may have more than 64 bits", node)
        return value

    def number(self, node: yaml.ScalarNode) -> float:
        _refuse_long(node)
        _refuse_ambiguous(node)
        return self.construct_yaml_float(node)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, dict | list | set):
                raise _refused("a key has to be text", key_node)
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key!r} is written twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


_StrictLoader.add_constructor("tag:yaml.org,2002:int", _StrictLoader.whole_number)
_StrictLoader.add_constructor("tag:yaml.org,2002:float", _StrictLoader.number)


def _count(node: yaml.Node, known: dict[int, int | None]) -> int:
    """Return how many values a node stands for, aliases followed; raise ConstructorError for too many, or a cycle.

    `known` maps the identity of each node counted before to its count, or to None while it is being counted.
    """
    if id(node) in known:
        before = known[id(node)]
        if before is None:
            raise _refused("an alias must not occur within what it names", node)
        return before
    known[id(node)] = None
    count = 1
    if isinstance(node, yaml.SequenceNode):
        count += sum(_count(one, known) for one in node.value)
    elif isinstance(node, yaml.MappingNode):
        count += sum(_count(key, known) + _count(value, known) for key, value in node.value)
    if count > MAX_VALUES:
        raise _refused(f"at most {MAX_VALUES} values, where an alias counts as what it names", node)
    known[id(node)] = count
    return count


def _refuse_long(node: yaml.ScalarNode) -> None:
    # A long number takes long: PyYAML multiplies the parts of 1:59:59 one by one, and Python refuses to print it.
    if len(node.value) > _MAX_NUMBER_CHARACTERS:
        raise _refused("no number may have more than 64 bits", node)


def _refuse_ambiguous(node: yaml.ScalarNode) -> None:
    """Refuse what YAML 1.1 reads in base 8 or 60, but people in base 10: 0123 is 83, 1:30 is 90."""
    digits = node.value.lstrip("+-").replace("_", "")
    if ":" in digits or (digits[:1] == "0" and digits[1:2].isdigit()):
        raise _refused(f"write {node.value} without leading zeros or colons, or, if it is text, in quotes", node)


def _refused(rule: str, node: yaml.Node) -> yaml.constructor.ConstructorError:
    return yaml.constructor.ConstructorError(None, None, rule, node.start_mark)


def read_text(path: Path) -> str:
    """Return the file's text; raises ConfigError."""
    try:
        data = read_regular(path, MAX_CONFIG_BYTES + 1)
    except OSError as error:
        raise ConfigError(str(path), "", f"cannot be read: {error.strerror or error}") from error
    if len(data) > MAX_CONFIG_BYTES:
        raise ConfigError(str(path), "", f"expected at most {MAX_CONFIG_BYTES} bytes of YAML")
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise ConfigError(str(path), "", f"expected UTF-8: {error.reason} at byte {error.start}") from error


def parse_yaml(text: str, source: str) -> dict[str, Any]:
    """Return the one mapping that the text holds; raises ConfigError."""
    try:
        # The loader derives from SafeLoader: only plain values come out.
        data = yaml.load(text, Loader=_StrictLoader)  # noqa: S506 - a SafeLoader underneath
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"line {mark.line + 1}" if mark else ""
        lines = text.splitlines()[max(0, mark.line - 1) : mark.line + 1] if mark else []
        hint = "; put a value that begins with [ or * in quotes" if any(map(_UNQUOTED.search, lines)) else ""
        raise ConfigError(source, where, f"expected YAML: {error.problem or error.context}{hint}") from error
    except (yaml.YAMLError, ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        # The constructors of the YAML package leak these errors for malformed scalars (!!int x, 2026-02-31).
        raise ConfigError(source, "", f"expected YAML: {_one_line(str(error))}") from error
    if data is None:
        raise ConfigError(source, "", "expected keys and values, but it is empty; deploy/config has examples")
    if not isinstance(data, dict):
        raise ConfigError(source, "", f"expected keys and values, got {_shown(data)}")
    for key in data:
        if not isinstance(key, str):
            raise ConfigError(source, _shown(key), "expected a key that is text; quote it")
    return data


def validate(model: type[Model], data: Mapping[str, Any], source: str) -> Model:
    """Return the validated model; raises ConfigError with the first problem and how many follow."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        problems = _root_problems(error.errors(include_url=False))
        first = problems[0]
        text = _describe(model, first)
        if len(problems) > 1:
            text += f" (and {len(problems) - 1} more)"
        raise ConfigError(source, key_path(first["loc"]), text) from error


def key_path(location: Iterable[str | int]) -> str:
    """Return a location in the notation of the file's reader: services[0].deadline_ms."""
    path = ""
    for part in location:
        if isinstance(part, int):
            path += f"[{part}]"
        else:
            path += f".{part}" if path else part
    return path


def _root_problems(problems: list[ErrorDetails]) -> list[ErrorDetails]:
    """Leave out problems that only follow from one of another field or of a list's entry."""
    parents = {problem["loc"][:length] for problem in problems for length in range(len(problem["loc"]))}
    return [
        problem
        for problem in problems
        if problem["type"] != "default_factory_not_called"
        and not (problem["type"] == "too_short" and problem["loc"] in parents)
    ]


def _describe(model: type[BaseModel], problem: ErrorDetails) -> str:
    kind = problem["type"]
    if kind == "missing":
        return "expected, but missing"
    if kind == "extra_forbidden":
        known = _keys_at(model, problem["loc"][:-1])
        close = difflib.get_close_matches(str(problem["loc"][-1]), known, n=1, cutoff=0.5)
        hint = f"did you mean {close[0]}?" if close else f"expected one of {', '.join(known)}"
        return f"unknown key; {hint}"
    if kind == "invalid_key":
        return f"expected a key that is text, got {_shown(problem['loc'][-1])}; quote it"
    if kind == "too_short":
        return f"expected at least {problem['ctx']['min_length']} entry"
    if kind in _EXPECTED:
        return f"expected {_EXPECTED[kind]}, got {_shown(problem['input'])}{_number_hint(kind, problem['input'])}"
    message = problem["msg"].removeprefix("Value error, ")
    if message.startswith("Input should be "):
        message = f"expected {message.removeprefix('Input should be ')}, got {_shown(problem['input'])}"
    return _cut(_one_line(message))


def _number_hint(kind: str, value: object) -> str:
    if kind in ("int_type", "float_type") and isinstance(value, str) and _EXPONENT.fullmatch(value):
        return "; YAML takes an exponent without a point and a sign for text: write it as 1000 or 1.0e+3"
    return ""


def _keys_at(model: type[BaseModel], location: tuple[str | int, ...]) -> list[str]:
    """Return the keys that the model, or the model nested in it at `location`, knows."""
    schema = model.model_json_schema()
    definitions = schema.get("$defs", {})
    here: dict[str, Any] = schema
    for part in location:
        here = here.get("items", {}) if isinstance(part, int) else here.get("properties", {}).get(part, {})
        for option in (here, *here.get("anyOf", ()), *here.get("allOf", ())):
            if "$ref" in option:
                here = definitions[option["$ref"].rsplit("/", 1)[-1]]
                break
            if "items" in option:
                here = option
                break
        if "$ref" in here:
            here = definitions[here["$ref"].rsplit("/", 1)[-1]]
    return sorted(here.get("properties", ()))


def _shown(value: object) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= _SHOWN_INPUT_CHARACTERS else text[:_SHOWN_INPUT_CHARACTERS] + "…"


def _cut(text: str) -> str:
    return text if len(text) <= _MAX_PROBLEM_CHARACTERS else text[:_MAX_PROBLEM_CHARACTERS] + "…"


def _one_line(text: str) -> str:
    return " ".join(text.split())
