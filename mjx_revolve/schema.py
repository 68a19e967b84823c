"""Command line: JSON Schema of our YAML files, by which editors complete and underline.

``python -m mjx_revolve.schema config > config.json``; a file names its schema in a comment,
``# yaml-language-server: $schema=config.json``. Those of the shipped files lie in `schemas/`.
What depends on several values at once, or on other files, is checked when a file is read.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from mjx_revolve.inputs.commands import Parser, program, run_command

Schema = dict[str, Any]
Generate = Callable[[Any], Schema]
FOLDER = Path(__file__).with_name("schemas")
"""The schemas of shipped files."""


def _of(name: str) -> Callable[[Generate], Schema]:
    """A class's schema; the class is imported when it is made."""
    return lambda generate: generate(resolve_name(f"mjx_revolve.{name}"))


def _modules(generate: Generate) -> Schema:
    """Module types as users write them; see `body/module_files.py`."""
    from mjx_revolve.body.module_types import ModuleType

    found = generate(ModuleType)
    definitions = found.pop("$defs")
    face = {"type": "string", "pattern": "^[-+]?[xy]$"}
    part, kind = definitions["Part"], found
    part["properties"]["size"] = definitions["Box"]["properties"]["size"]
    part["required"] = ["mass"]
    part["oneOf"] = [{"required": ["size"]}, {"required": ["boxes"]}]
    del kind["properties"]["name"]
    kind["required"] = ["mount", "parts"]
    kind["properties"]["mount"]["anyOf"].append(face)
    slot = {"anyOf": [{"$ref": "#/$defs/Slot"}, face]}
    slots = {"type": "object", "additionalProperties": slot}
    kind["properties"]["slots"] = {"anyOf": [slots, {"type": "null"}]}
    return _file({"modules": {"type": "object", "minProperties": 1, "additionalProperties": kind}},
                 definitions, ["modules"])  # fmt: skip


def _morphology(generate: Generate) -> Schema:
    """A tree of modules; see `make_morphology`. Types may be users' own; brains are not checked."""
    from pydantic import ConfigDict, create_model

    from mjx_revolve.body.catalogue import MODULES
    from mjx_revolve.body.params import PARAMS
    from mjx_revolve.body.sensors import SensorRow

    fields: Any = {name: (kind | None, None) for name, kind in PARAMS.items()}
    params = generate(create_model("Params", __config__=ConfigDict(extra="allow"), **fields))
    sensors = generate(SensorRow)
    name = {"type": ["string", "integer", "null"]}
    module = {
        "type": "object",
        "properties": {
            "id": name,
            "type": {"anyOf": [{"enum": sorted(MODULES)}, {"type": "string"}]},
            "slot": {},
            "orientation": {"type": ["number", "string", "null"]},
            "params": {"anyOf": [{"$ref": "#/$defs/Params"}, {"type": "null"}]},
            "children": {
                "type": ["object", "null"],
                "additionalProperties": {"$ref": "#/$defs/Module"},
            },
        },
        "required": ["type"],
        "additionalProperties": False,
    }
    definitions = params.pop("$defs", {}) | sensors.pop("$defs", {})
    definitions |= {"Params": params, "Module": module}
    keys = {"id": name, "body": {"$ref": "#/$defs/Module"}, "brain": {}}
    keys["sensors"] = {"anyOf": [sensors, {"type": "null"}]}
    keys["coefficients"] = {"type": ["string", "null"]}
    return _file(keys, definitions, ["body"])


def _file(keys: Schema, definitions: Schema, required: list[str]) -> Schema:
    whole = {"type": "object", "properties": keys, "required": required}
    return {**whole, "additionalProperties": False, "$defs": definitions}


KINDS: dict[str, Callable[[Generate], Schema]] = {
    "config": _of("episodes.config:Config"),
    "modules": _modules,
    "morphology": _morphology,
    "sweep": _of("evolution.sweeps:Sweep"),
    "world": _of("water.world:World"),
}


def make_schema(kind: str) -> dict[str, Any]:
    """The JSON Schema (2020-12) of a kind of file.

    Args:
        kind: a name in `KINDS`.

    Returns:
        The schema, as `json` takes it.
    """
    from pydantic import TypeAdapter
    from pydantic.json_schema import GenerateJsonSchema

    class _Generator(GenerateJsonSchema):
        """Takes the short forms that functions before validation state; see `schema.also`."""

        def function_before_schema(self, schema: Any) -> Any:
            """The type behind the function, or one of its further forms."""
            function = schema["function"]["function"]
            if hasattr(function, "names"):
                names = function.names()
                return {"enum": [*names, False] if "off" in names else names}
            usual = self.generate_inner(schema["schema"])
            forms = [x or usual["items"] for x in getattr(function, "also", ())]
            return {"anyOf": [usual, *forms]} if forms else usual

        def is_instance_schema(self, schema: object) -> Any:
            """Objects are named by files in YAML."""
            return {"type": "string"}

    generate = lambda kind: TypeAdapter(kind).json_schema(schema_generator=_Generator)  # noqa: E731
    found = _with_bounds(KINDS[kind](generate))
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **found}


# How pydantic leaves bounds of numbers that a function has checked.
_BOUNDS = {"ge": "minimum", "gt": "exclusiveMinimum", "le": "maximum", "lt": "exclusiveMaximum"}


def _with_bounds(value: object) -> Any:
    """A schema with its bounds under JSON Schema's names."""
    if isinstance(value, list):
        return [_with_bounds(x) for x in value]
    if not isinstance(value, dict):
        return value
    bound = lambda key, x: key in _BOUNDS and isinstance(x, int | float)  # noqa: E731
    return {_BOUNDS[k] if bound(k, x) else k: _with_bounds(x) for k, x in value.items()}


def show_schema(kind: str) -> str:
    """The text of a schema's file."""
    return json.dumps(make_schema(kind), indent=1, ensure_ascii=False) + "\n"


def main(argv: list[str] | None = None) -> int:
    """Prints a schema, or writes all of them."""
    parser = Parser(
        prog=program("schema"),
        description="Print the JSON Schema of a kind of YAML, by which editors complete it.",
        examples=("schema config > config.json",),
    )
    parser.add_argument("kind", choices=KINDS, help="of file")
    print(show_schema(parser.parse_args(argv).kind), end="")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
