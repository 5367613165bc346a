"""What a declared type, its field and a value are called in messages."""

import inspect
import re
import reprlib
from collections.abc import Callable
from dataclasses import MISSING
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin

import numpy as np

PLAIN = {float: "a number", int: "a whole number", bool: "true or false", str: "text", NoneType: "None"}
PLURALS = {float: "numbers", int: "whole numbers", bool: "values true or false", str: "texts"}
OF_ARRAYS = {"f": "numbers", "i": "whole numbers", "u": "whole numbers", "b": "true and false"}
PLACEHOLDERS = {float: "0.0", int: "1", bool: "True"}  # in an example of a field that has no default


def is_array(hint: Any) -> bool:
    """Whether a declared type is jaxtyping's, of NumPy."""
    return getattr(hint, "array_type", None) is np.ndarray


def one_dtype(hint: Any) -> np.dtype | None:
    """The dtype of a declared array; None where it may be one of several, as with jaxtyping's Float, or is of no numbers that we have a word for."""
    try:
        (kind,) = {np.dtype(name) for name in hint.dtypes}
    except (TypeError, ValueError):  # of no dtype, as Shaped, or one that NumPy lacks; of several
        return None
    return kind if kind.kind in OF_ARRAYS else None


def expected(hint: Any) -> str:
    """A declared type in words: "3 numbers" for tuple[float, float, float]."""
    origin, inner = get_origin(hint), get_args(hint)
    if is_array(hint):
        kind = one_dtype(hint)
        return f"an array ({', '.join(hint.dim_str.split())}) of {f'type {hint.dtype.__name__}' if kind is None else OF_ARRAYS[kind.kind]}"
    if origin in (Union, UnionType):
        return " or ".join(expected(one) for one in inner if not (one is int and float in inner))
    if origin is tuple:
        return f"{'a tuple of' if Ellipsis in inner else len(inner)} {PLURALS.get(inner[0], f'values, each {expected(inner[0])}')}"
    if origin is dict:
        return f"a dict of names, each with {expected(inner[1])}"
    if origin is Callable:
        return "a function"
    return PLAIN.get(hint) or (_with_kinds(hint) if isinstance(hint, type) else str(hint))


def as_found(value: Any, hint: Any) -> str:
    """What was found where that type is declared."""
    if isinstance(value, type):
        return f"the class {value.__name__}, of which nothing is made yet (write {value.__name__}(...))"
    if callable(value) and hasattr(value, "__name__"):
        return f"the function {value.__name__}"
    if is_array(hint) and isinstance(value, list | tuple):
        try:
            value = np.asarray(value)
        except ValueError:  # rows of unequal lengths
            return f"a {type(value).__name__} of {len(value)}"
    if getattr(value, "ndim", 0) > 0 and hasattr(value, "dtype"):
        return f"an array {tuple(value.shape)} of {value.dtype}"
    return reprlib.repr(value)


def words_of(kind: type, name: str) -> str:
    """What stands behind a field in its class's source, such as "m/s^2". Empty where nothing does, and where there is no source."""
    home = next((one for one in kind.__mro__ if name in inspect.get_annotations(one)), kind)
    try:
        said = re.search(rf"^\s+{name}\s*:[^#\n]*#\s*(.+)$", inspect.getsource(home), re.MULTILINE)
    except (OSError, TypeError):  # typed at a prompt
        return ""
    return said[1].strip() if said else ""


def example(entry: Any, hint: Any) -> str:
    """How a dataclass's field may be written: its default, or a placeholder. Empty where that is no help."""
    said = "" if entry.default is MISSING or entry.default is None else repr(entry.default)
    return said if said and "inf" not in said else placeholder(hint)  # Python does not read inf


def placeholder(hint: Any) -> str:
    """A number, or a tuple of them, of a declared type; empty for other types."""
    if get_origin(hint) is tuple and all(one in PLACEHOLDERS for one in get_args(hint)):
        return f"({', '.join(PLACEHOLDERS[one] for one in get_args(hint))})"
    return PLACEHOLDERS.get(hint, "")


def _with_kinds(hint: Any) -> str:
    """A class, and the kinds of it that come with it."""
    kinds = ", ".join(kind.__name__ for kind in hint.__subclasses__() if kind.__module__ == hint.__module__ and not inspect.isabstract(kind))
    return f"{'an' if hint.__name__[0] in 'AEIOU' else 'a'} {hint.__name__}{f' ({kinds})' if kinds else ''}"
