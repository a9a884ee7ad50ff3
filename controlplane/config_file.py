"""YAML into a validated model, every problem as one line that names file, key and what was expected."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from protos.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

Model = TypeVar("Model", bound=BaseModel)

MAX_CONFIG_BYTES = 1 << 20
"""A configuration is written by hand; a larger file is some other file."""

_EXPECTED = {
    "bool_type": "true or false",
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "text",
    "tuple_type": "a list",
}
"""What the reader of a YAML file calls the kinds of values."""


class _StrictLoader(yaml.SafeLoader):
    """Refuses a key written twice, of which YAML would silently keep the last."""


def _construct_mapping(loader: _StrictLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    loader.flatten_mapping(node)
    keys = [loader.construct_object(key, deep=True) for key, _ in node.value]
    for key, (key_node, _) in zip(keys, node.value, strict=True):
        if not isinstance(key, str):
            raise yaml.constructor.ConstructorError(None, None, "a key that is not text", key_node.start_mark)
        if keys.count(key) > 1:
            raise yaml.constructor.ConstructorError(None, None, f"key {key!r} is written twice", key_node.start_mark)
    return loader.construct_mapping(node, deep=True)


_StrictLoader.add_constructor("tag:yaml.org,2002:map", _construct_mapping)


def load(model: type[Model], path: Path) -> Model:
    """Read and check a file; raises ConfigError and nothing else."""
    source = str(path)
    try:
        with path.open("rb") as file:
            data = file.read(MAX_CONFIG_BYTES + 1)
    except OSError as error:
        raise ConfigError(source, "", f"cannot be read: {error.strerror or error}") from error
    if len(data) > MAX_CONFIG_BYTES:
        raise ConfigError(source, "", f"expected at most {MAX_CONFIG_BYTES} bytes of YAML")
    return parse(model, data, source)


def parse(model: type[Model], data: bytes, source: str) -> Model:
    """Check the bytes of a file called `source`; raises ConfigError and nothing else."""
    try:
        text = data.decode()
        values = yaml.load(text, Loader=_StrictLoader)  # noqa: S506 - derived from SafeLoader: plain values only
    except yaml.MarkedYAMLError as error:
        where = f"line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ConfigError(source, where, f"expected YAML: {error.problem or error.context}") from error
    except (yaml.YAMLError, ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
        # What the YAML package lets slip for malformed scalars (!!int x, 2026-02-31), and bytes that are not UTF-8.
        raise ConfigError(source, "", f"expected YAML: {' '.join(str(error).split())}") from error
    if values is None:
        values = {}
    if not isinstance(values, dict):
        raise ConfigError(source, "", f"expected keys and values, got {_shown(values)}")
    try:
        return model.model_validate(values)
    except ValidationError as error:
        problems = error.errors(include_url=False)
        first = problems[0]
        key = "".join(f"[{part}]" if isinstance(part, int) else str(part) for part in first["loc"])
        rest = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise ConfigError(source, key, _describe(model, dict(first)) + rest) from error


def _describe(model: type[BaseModel], problem: dict[str, Any]) -> str:
    if problem["type"] == "extra_forbidden":
        known = sorted(model.model_fields)
        close = difflib.get_close_matches(str(problem["loc"][-1]), known, n=1, cutoff=0.5)
        return "unknown key; " + (f"did you mean {close[0]}?" if close else f"expected one of {', '.join(known)}")
    if problem["type"] in _EXPECTED:
        return f"expected {_EXPECTED[problem['type']]}, got {_shown(problem['input'])}"
    message = str(problem["msg"]).removeprefix("Value error, ")
    if message.startswith("Input should be "):
        message = f"expected {message.removeprefix('Input should be ')}, got {_shown(problem['input'])}"
    return " ".join(message.split())


def _shown(value: object) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 60 else text[:60] + "…"
