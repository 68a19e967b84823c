"""Safe YAML: reads `1e-3` as a number; refuses duplicate keys, deep nesting and huge documents.

What is written is read back as it was, but for the control character U+0085, as a blank.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Hashable
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from mjx_revolve.inputs.errors import InputError, reading, show
from mjx_revolve.inputs.files import read_file
from mjx_revolve.inputs.trust import audit

# Revolve's deepest evolved robots stay below 60 levels of YAML; Python's own recursion limit is
# 1000. A file nested deeper than this is a mistake or an attack.
_MAX_DEPTH = 200
# Nested aliases can make a small file huge ("billion laughs"); our files need no aliases at all.
_MAX_NODES = 200_000
# PyYAML reads some 20,000 values in a second; a robot of a thousand modules has as many.
_MAX_WRITTEN = 100_000
# It reads some 500 kB in a second; a robot of a thousand modules is a fifth of that.
_MAX_BYTES = 2_000_000
# Python refuses to print integers of more than 4300 digits.
_MAX_BITS = 14_000


def _too_deep() -> InputError:
    return InputError(f"expected at most {_MAX_DEPTH} levels of nesting; found more")


def _line_of(node: yaml.Node) -> str:
    return f"line {node.start_mark.line + 1}"


class SafeLoader(yaml.SafeLoader):
    """`yaml.SafeLoader` that reads `1e-3` as a number and refuses duplicate keys.

    It also refuses tags beyond mappings, lists, texts, numbers, truth values and dates, and what is
    nested too deeply or too large, as soon as possible.
    """

    _depth = _count = 0

    def fetch_flow_collection_start(self, token: yaml.Token) -> None:
        """Scans a `[` or a `{`; PyYAML's time grows with the square of how many are open."""
        if self.flow_level > _MAX_DEPTH:
            raise _too_deep()
        super().fetch_flow_collection_start(token)

    def compose_node(self, parent: Any, index: Any) -> Any:
        """The next node and all within it."""
        self._depth += 1
        self._count += 1
        if self._depth > _MAX_DEPTH:
            raise _too_deep()
        if self._count > _MAX_WRITTEN:
            raise InputError(f"expected at most {_MAX_WRITTEN} values; found more")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """The value of a node; a text that its tag cannot have (`!!int x`) is an `InputError`."""
        try:
            return super().construct_object(node, deep)
        except (InputError, yaml.YAMLError, RecursionError):
            raise
        except Exception as error:  # PyYAML's constructors do not check the text against the tag
            kind = node.tag.rpartition(":")[2]
            reason = f": {error}" if isinstance(error, ValueError) else ""
            found = f"{show(node.value)} as {kind}{reason}"
            raise InputError(_line_of(node), "valid YAML", found) from None


# YAML 1.1 floats need a dot and no sign before it; users write 1e-3 and -.5 for numbers.
SafeLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(
        r"^[-+]?(?:(?:[0-9][0-9_]*\.?[0-9_]*|\.[0-9][0-9_]*)[eE][-+]?[0-9]+|\.[0-9][0-9_]*)$"
    ),
    list("-+.0123456789"),
)


def _construct_mapping(loader: SafeLoader, node: yaml.MappingNode) -> dict[Hashable, Any]:
    mapping: dict[Hashable, Any] = {}
    for key_node, value_node in node.value:
        if key_node.tag == "tag:yaml.org,2002:merge":
            raise InputError(_line_of(key_node), "each key by its name", "<<, which merges")
        key = loader.construct_object(key_node, deep=True)
        if not isinstance(key, Hashable):
            raise InputError(_line_of(key_node), "a plain key", show(key))
        if key in mapping:
            raise InputError(_line_of(key_node), "each key once", f"{show(key)} twice")
        mapping[key] = loader.construct_object(value_node, deep=True)
    return mapping


# YAML 1.1 takes 012 for 10 and 1:30 for 90, YAML 1.2 for neither.
_OCTAL = re.compile(r"[-+]?0[0-7_]")


def _check_base(node: yaml.ScalarNode, octal: bool) -> None:
    if ":" in node.value or (octal and _OCTAL.match(node.value)):
        expected = "a number without a leading 0 or a colon, or a text in quotes"
        raise InputError(_line_of(node), expected, node.value)


def _construct_float(loader: SafeLoader, node: yaml.ScalarNode) -> float:
    _check_base(node, octal=False)
    return loader.construct_yaml_float(node)


def _construct_int(loader: SafeLoader, node: yaml.ScalarNode) -> int:
    _check_base(node, octal=True)
    value = yaml.SafeLoader.construct_yaml_int(loader, node)
    if value.bit_length() > _MAX_BITS:  # hexadecimal digits may be as many as there are
        raise InputError(_line_of(node), "a whole number of a few digits", "a huge integer")
    return value


SafeLoader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _construct_mapping)
SafeLoader.add_constructor("tag:yaml.org,2002:int", _construct_int)
SafeLoader.add_constructor("tag:yaml.org,2002:float", _construct_float)
for _name in ("binary", "omap", "pairs", "set"):  # bytes, tuples and sets: no file of ours has any
    del SafeLoader.yaml_constructors[f"tag:yaml.org,2002:{_name}"]


def check_size(data: object) -> None:
    """Raises `InputError` for values that are nested too deeply, or too many, to be read."""
    stack, count = [(data, 0)], 0
    while stack:
        item, depth = stack.pop()
        count += 1
        if depth > _MAX_DEPTH:
            raise _too_deep()
        if count > _MAX_NODES:
            raise InputError(f"expected at most {_MAX_NODES} values; found more (aliases?)")
        if isinstance(item, dict):
            item = list(item.values())
        if isinstance(item, list):
            stack.extend((value, depth + 1) for value in item)


def load_yaml(path: str | Path) -> Any:
    """Reads one YAML document as plain values (dict, list, str, int, float, bool, None).

    Raises:
        InputError: the file is missing, unreadable, no valid YAML, nested too deeply, or repeats a
            key.
    """
    content = read_file(path, _MAX_BYTES + 1)
    if len(content) > _MAX_BYTES:
        raise InputError(path, f"at most {_MAX_BYTES // 10**6} MB of YAML", "more")
    audit(path, "data", content)
    return parse_yaml(content, path)


def parse_yaml(content: bytes, path: str | Path) -> Any:
    """The plain values of a YAML document read from `path`, which `load_yaml` audits first."""
    with reading(path):
        text = content.decode("utf-8")
        try:
            return copy.deepcopy(_parse(text))
        except RecursionError:
            raise _too_deep() from None
        except InputError:
            raise
        except (ValueError, OverflowError) as error:  # "\U00110000", %YAML 1.1111...
            raise InputError(f"expected valid YAML; found: {error}") from None
        except yaml.YAMLError as error:
            mark = getattr(error, "problem_mark", None)
            place = f"line {mark.line + 1}: " if mark else ""
            problem = getattr(error, "problem", None) or str(error).splitlines()[0]
            raise InputError(f"{place}expected valid YAML; found: {problem}") from None


@lru_cache(maxsize=16)
def _parse(text: str) -> Any:
    """Kept, as a command reads a world eight times and PyYAML takes longer than all else of it."""
    data = yaml.load(text, Loader=SafeLoader)
    check_size(data)
    return data


class _Dumper(yaml.SafeDumper):
    """Quotes texts that `SafeLoader` would take for a number (`1e3`)."""

    yaml_implicit_resolvers = SafeLoader.yaml_implicit_resolvers

    def ignore_aliases(self, data: object) -> bool:
        """Writes shared values in full."""
        return True


def dump_yaml(data: object, **style: Any) -> str:
    """Plain values as YAML, mappings in their order; `style` as `yaml.dump` has it."""
    return str(yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, **style))
