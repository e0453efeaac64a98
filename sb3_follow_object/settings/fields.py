"""What one setting is, and how a value for it becomes one: pydantic's types, our sentences."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from ..common.numbers import as_flag, as_number, as_whole, shown
from ..common.suggestions import did_you_mean

LARGEST = 10**15  # of whole numbers: more is a mistake


@dataclass(frozen=True)
class Said:
    """What a sentence calls the values of a type."""

    kind: str


class Unfit(ValueError):
    """Raised by what reads a value with parts: its sentence says which of them is invalid."""


Whole = Annotated[int, BeforeValidator(as_whole), Said("a whole number")]
Number = Annotated[float, BeforeValidator(as_number), Said("a number")]
Flag = Annotated[bool, BeforeValidator(as_flag), Said("true or false")]
Text = Annotated[str, Said("text")]


def setting(
    sentence: str,
    *,
    unit: str = "",
    none: str = "",
    data: bool = True,
    group: type[Group] | None = None,
    without: Collection[str] = (),
    name: str | None = None,
    **limits: float,
) -> Any:
    """Describe a field of a group.

    Args:
        sentence: says what it is.
        unit: of its value.
        none: what None stands for, where that is its default.
        data: whether YAML and --set can give it; False for what only Python code can.
        group: whose settings its value, a mapping, holds.
        without: those of the group's that it may not hold.
        name: that it has in data, where that is another than the field's.
        **limits: pydantic's ge, gt, le and lt.
    """
    facts = {"unit": unit, "none": none, "data": data, "group": group, "without": tuple(without)}
    return Field(description=sentence, alias=name, json_schema_extra=facts, **limits)  # type: ignore


@dataclass(frozen=True)
class Setting:
    """One setting of a group; its attributes are what `setting` and the field say."""

    field: str
    name: str
    default: Any
    sentence: str
    hint: Any
    may_be_none: bool
    limits: dict[str, float]
    unit: str
    none: str
    data: bool
    group: type[Group] | None
    without: tuple[str, ...]

    @cached_property
    def _adapter(self) -> TypeAdapter[Any]:
        limits: dict[str, Any] = dict(self.limits)
        if self.kind == "a number":
            limits["allow_inf_nan"] = False
        elif self.kind == "a whole number":
            limits.setdefault("le", LARGEST)
        hint: Any = Annotated[(self.hint, Field(**limits))] if limits else self.hint
        return TypeAdapter(hint)

    @cached_property
    def kind(self) -> str:
        """What a sentence calls its values."""
        if self.group is not None:
            return "a mapping"
        if get_origin(self.hint) is Literal:
            *first, last = map(repr, get_args(self.hint))
            return f"{', '.join(first)} or {last}" if first else last
        return next((m.kind for m in get_args(self.hint) if isinstance(m, Said)), "")

    @cached_property
    def range(self) -> str:
        """Its range: an interval of numbers, or "" where there is none to tell."""
        ends = {name: f"{limit:.15g}" for name, limit in self.limits.items()}
        if self.kind == "a whole number":
            if "ge" in ends and "le" in ends:
                return f"{ends['ge']}..{ends['le']}"
            return f">= {ends['ge']}" if "ge" in ends else ""
        if not ends:
            return ""
        low = f"[{ends['ge']}" if "ge" in ends else f"({ends.get('gt', '-inf')}"
        high = f"{ends['le']}]" if "le" in ends else f"{ends.get('lt', 'inf')})"
        return f"{low}, {high}"

    def checked(self, value: Any, where: str = "", data: bool = False) -> Any:
        """Return a value as the setting has it.

        Args:
            value: given for it.
            where: beginning of the sentence about one that is invalid.
            data: as in `checked`.

        Raises:
            ValueError: it has another type or is outside the range.
        """
        before = f"{where}: " if where else ""
        if value is None and self.may_be_none:
            return None
        if self.group is not None:
            if not isinstance(value, Mapping):
                raise ValueError(f"{before}{self.name} must be a mapping, not {shown(value)}")
            return checked(self.group, value, f"{before}{self.name}", self.without, data)
        try:
            return self._adapter.validate_python(value)
        except ValidationError as error:
            first = error.errors()[0]
            cause = first.get("ctx", {}).get("error")
            if isinstance(cause, Unfit):
                raise ValueError(f"{before}{self.name}: {cause}") from None
            reason = self._reason(value, str(first["type"]))
            raise ValueError(f"{before}{self.name} {reason}") from None

    def _reason(self, value: Any, error: str) -> str:
        unit = f" {self.unit}" if self.unit else ""
        given = shown(value)
        if self.kind == "a whole number":
            if error == "greater_than_equal":
                return f"is {given}; it must be at least {self.limits['ge']}"
            if error == "less_than_equal":
                return f"is {given}; it must be at most {self.limits.get('le', LARGEST)}"
        elif error in ("finite_number", *_OUT_OF_RANGE):
            return f"is {given}; it must lie in {self.range or '(-inf, inf)'}{unit}"
        return f"must be {self.kind}, not {given}"


_OUT_OF_RANGE = ("greater_than", "greater_than_equal", "less_than", "less_than_equal")


class Group:
    """Settings that belong together: a frozen dataclass whose instances hold checked values.

    The class itself holds the defaults, so that signatures can take them from there.

    Attributes:
        title: what tables call the group.
        where: beginning of a sentence about an instance's value that is invalid.
        of_name: what a sentence about data adds to the name of the mapping.
    """

    title: ClassVar[str] = ""
    where: ClassVar[str] = ""
    of_name: ClassVar[str] = ""

    def __post_init__(self) -> None:
        for each in settings_of(type(self)).values():
            if each.name != each.field:
                each = dataclasses.replace(each, name=each.field)
            value = each.checked(getattr(self, each.field), self.where)
            object.__setattr__(self, each.field, value)

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> type[Group]:
        """Return the group that a mapping holds settings of: this one, unless a value decides."""
        return cls


def settings_of(group: type[Group]) -> dict[str, Setting]:
    """Return a group's settings by the names that they have in data."""
    if group not in _FOUND:
        _FOUND[group] = _read(group)
    return _FOUND[group]


_FOUND: dict[type[Group], dict[str, Setting]] = {}


def _read(group: type[Group]) -> dict[str, Setting]:
    hints = get_type_hints(group, include_extras=True)
    found = {}
    for field in dataclasses.fields(group):  # type: ignore[arg-type]
        hint = hints[field.name]
        info = next(
            (m for m in getattr(hint, "__metadata__", ()) if isinstance(m, FieldInfo)), None
        )
        if info is None:
            continue  # what an instance has besides settings
        facts: Any = info.json_schema_extra
        limits = {n: getattr(m, n) for m in info.metadata for n in _LIMITS if hasattr(m, n)}
        name = info.alias or field.name
        found[name] = Setting(
            field=field.name,
            name=name,
            default=None if field.default is dataclasses.MISSING else field.default,
            sentence=info.description or "",
            hint=_bare(hint),
            may_be_none=type(None) in get_args(hint.__origin__),
            limits=limits,
            **facts,
        )
    return found


_LIMITS = ("ge", "gt", "le", "lt")


def _bare(hint: Any) -> Any:
    """Return a field's type without its description, and without None."""
    origin = hint.__origin__
    metadata = [each for each in hint.__metadata__ if not isinstance(each, FieldInfo)]
    if get_origin(origin) in (Union, types.UnionType):
        options = [option for option in get_args(origin) if option is not type(None)]
        (origin,) = options  # what else a value may be is for a type of its own to say
    parts: Any = (origin, *metadata)
    return Annotated[parts] if metadata else origin


def check_names(given: Any, known: Collection[str], where: str) -> None:
    """Raise a ValueError unless what is given is a mapping that holds nothing but known names."""
    if not isinstance(given, Mapping):
        raise ValueError(f"{where} must be a mapping, not {shown(given)}")
    for name in given:
        if name not in known:
            raise ValueError(f"{where} has no setting {name!r}{did_you_mean(name, known)}")


def checked(
    group: type[Group],
    given: Mapping[str, Any],
    where: str,
    without: Collection[str] = (),
    data: bool = False,
) -> dict[str, Any]:
    """Return those of a group's settings that are given, as the group has them.

    Args:
        group: whose settings they are.
        given: by their names.
        where: beginning of the sentence about what is invalid.
        without: those of the group's that may not be given.
        data: refuse what only Python code can give.

    Raises:
        ValueError: an unknown name, with the nearest known one, or an invalid value.
    """
    group = group.of(given)
    if group is Anything:
        return dict(given)
    where += group.of_name
    known = {
        name: each
        for name, each in settings_of(group).items()
        if name not in without and (each.data or not data)
    }
    check_names(given, known, where)
    return {name: known[name].checked(value, where, data) for name, value in given.items()}


@dataclass(frozen=True)
class Anything(Group):
    """Settings of what is not this package's, which judges them itself."""
