"""What all sections of a configuration have in common, and how one of them names what it means."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from mjx_revolve.inputs.own_code import parse_own, short_name
from mjx_revolve.inputs.schema import MisfitError


def one_of(names: Iterable[str]) -> Any:
    """A name of ours or a function in a file of the user's own, as `Annotated` takes it."""
    return Field(
        pattern=rf"^({'|'.join(names)}|.+\.py:[^\W\d]\w*)$",
        description=f"one of {', '.join(names)}, or FILE.py:FUNCTION",
    )


class Settings(BaseModel):
    """Checked when it is made, and frozen."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, validate_default=True
    )

    def __repr_args__(self) -> Any:
        """What is not as usual."""
        usual = {name: field.default for name, field in type(self).model_fields.items()}
        return [(k, v) for k, v in super().__repr_args__() if k not in usual or usual[k] != v]


class Section(Settings):
    """A section whose `type` names one of ours, or a function in a file of the user's own."""

    type: str

    @property
    def name(self) -> str:
        """What titles call it: its type, or the name of the user's own function."""
        return short_name(self.type)

    @property
    def is_own(self) -> bool:
        """Whether it is a function in a file of the user's own."""
        return parse_own(self.type) is not None

    def refuse_params(self, params: Mapping[str, Any]) -> None:
        """Refuses `params` of what is not the user's own."""
        if params and not self.is_own:
            raise MisfitError("params", "none, as only own functions take them", ", ".join(params))
