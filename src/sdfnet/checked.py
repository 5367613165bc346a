"""Fields that are what they declare: a value is taken where the declared type holds it, numbers to rounding, and refused in words where it does not.

So a list or an array is taken for a tuple, nested lists or a PyTorch tensor on the CPU for an array, 5 for 5.0 and 5.0
for 5, 1 for true; "5e3" is taken for no number, 5.5 for no whole one, and -9.81 for no three numbers.
A type that sdfnet has no word for, such as Literal, is not looked at.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cache
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from jaxtyping import jaxtyped

from sdfnet.declared import as_found, example, expected, is_array, one_dtype, words_of
from sdfnet.errors import ConfigurationError

KINDS_TAKEN = {"f": "iuf", "i": "iuf", "u": "iuf", "b": "biu"}  # of NumPy's numbers, by that which is declared: truth values are no numbers


class Checked:
    """Base of the dataclasses that a user fills in. A `__post_init__` begins with `super().__post_init__()`, and has every field as declared from there.

    Raises ConfigurationError that names class and field, what was expected with its unit, what was found, and an example.
    """

    def __post_init__(self) -> None:
        kind: Any = type(self)
        for entry in fields(kind):  # whatever derives is a dataclass
            if not entry.init:
                continue
            place, value, hint = f"{kind.__name__}.{entry.name}", getattr(self, entry.name), _hints(kind)[entry.name]
            try:
                held = _held(value, hint, place)
            except _Unfit as unfit:
                about, right = words_of(kind, entry.name), example(entry, hint)
                cure = f"; write for example {entry.name}={right}" if right else ""
                raise _refusal(place, value, hint, f" ({about})" if about else "", f"{unfit}{cure}") from None
            object.__setattr__(self, entry.name, held)


def taken(place: str, value: Any, hint: Any) -> Any:
    """The value as the declared type holds it. Raises ConfigurationError that names the place where it does not."""
    try:
        return _held(value, hint, place)
    except _Unfit as unfit:
        raise _refusal(place, value, hint, "", str(unfit)) from None


class _Unfit(Exception):
    """The declared type does not hold the value; the text says why, where that is not plain."""


def _refusal(place: str, value: Any, hint: Any, about: str, more: str) -> ConfigurationError:
    return ConfigurationError(f"{place} must be {expected(hint)}{about}, found {as_found(value, hint)}{more}")


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _held(value: Any, hint: Any, place: str) -> Any:
    """The value as the type holds it. Raises _Unfit, and for what is wrong in a dict a ConfigurationError that names the entry."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if is_array(hint):
        return _array(value, hint)
    if origin in (Union, UnionType):
        return _first_held(value, inner, place)
    if origin is tuple:
        return _tuple(value, inner, place)
    if origin is dict:
        if not isinstance(value, Mapping):
            raise _Unfit
        return {_held(key, inner[0], place): taken(f"{place}[{key!r}]", one, inner[1]) for key, one in value.items()}
    if hint in _PLAIN:
        return _PLAIN[hint](value.item() if getattr(value, "ndim", None) == 0 else value)
    if origin is Callable and not callable(value) or isinstance(hint, type) and not isinstance(value, hint):  # what else may be declared is not looked at
        raise _Unfit
    return value


def _first_held(value: Any, choices: Sequence[Any], place: str) -> Any:
    for choice in choices:
        try:
            return _held(value, choice, place)
        except _Unfit:
            continue
    raise _Unfit


def _tuple(value: Any, inner: tuple[Any, ...], place: str) -> tuple[Any, ...]:
    values = value.tolist() if hasattr(value, "tolist") else value  # of NumPy and PyTorch
    if not isinstance(values, Sequence) or isinstance(values, str | bytes):
        raise _Unfit
    kinds = inner[:1] * len(values) if Ellipsis in inner else inner
    if len(kinds) != len(values):
        raise _Unfit
    return tuple(_held(one, kind, place) for one, kind in zip(values, kinds, strict=True))


@jaxtyped(typechecker=None)  # or a caller's own names of axes would hold here too
def _array(value: Any, hint: Any) -> np.ndarray:
    """The array as jaxtyping's type holds it, converted where that has one dtype; itself where it is that already."""
    try:
        given = np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:  # rows of unequal lengths; a tensor on a GPU, or with a gradient
        raise _Unfit(f": {error}") from error
    if isinstance(given, hint):
        return given
    kind = one_dtype(hint)
    if kind is None or given.dtype.kind not in KINDS_TAKEN[kind.kind]:
        raise _Unfit
    with np.errstate(invalid="ignore"):
        held = given.astype(kind)
    if not isinstance(held, hint):
        raise _Unfit
    if kind.kind != "f" and not np.array_equal(held, given):
        raise _Unfit(f", {given[held != given][0]} among them")
    return held


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, Real):
        raise _Unfit
    try:
        return float(value)
    except OverflowError as error:  # a whole number of more than 308 digits
        raise _Unfit(f": {error}") from error


def _whole_number(value: Any) -> int:
    if isinstance(value, bool) or not (isinstance(value, Integral) or (isinstance(value, float) and value.is_integer())):
        raise _Unfit
    return int(value)


def _truth(value: Any) -> bool:
    if not (isinstance(value, Integral) and value in (0, 1)):  # a bool is one
        raise _Unfit
    return bool(value)


def _text(value: Any) -> str:
    if not isinstance(value, str | os.PathLike):
        raise _Unfit
    return str(os.fspath(value))


def _nothing(value: Any) -> None:
    if value is not None:
        raise _Unfit


_PLAIN: dict[Any, Callable[[Any], Any]] = {float: _number, int: _whole_number, bool: _truth, str: _text, NoneType: _nothing}
