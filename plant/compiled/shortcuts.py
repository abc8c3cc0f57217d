"""What numba does again and again while it compiles, and what nobody reads, done once or not at all."""

import gc
import hashlib
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import cache
from typing import Any, cast

from numba.core import errors, event
from numba.core.cpu import CPUContext
from numba.core.ir import Inst, Var
from numba.core.targetconfig import ConfigStack
from numba.core.types import Record
from numba.core.types.functions import BaseFunction
from numba.core.untyped_passes import InlineClosureLikes
from numba.extending import register_jitable
from numba.np import arrayobj

_LAZY_COLLECTION = (50_000, 20, 20)
"""Collecting the many small objects as often as usual would take a third of the time."""

_resolve: Any = BaseFunction.get_call_type
_refresh: Any = CPUContext.refresh
_inline_closures: Any = InlineClosureLikes.run_pass
_Colours: Any = type(cast(Any, errors).termcolor())


@contextmanager
def shortcuts_taken() -> Iterator[None]:
    """Replace parts of numba meanwhile; what it compiles is the same, but for the text of an error that no kernel raises."""
    collection = gc.get_threshold()
    gc.set_threshold(*_LAZY_COLLECTION)
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in _SHORTCUTS]
    try:
        for owner, name, shortcut in _SHORTCUTS:
            setattr(owner, name, shortcut)
        yield
    finally:
        for owner, name, original in before:
            setattr(owner, name, original)
        gc.set_threshold(*collection)


def _resolve_once(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """As `get_call_type`, which searches all candidates at each use."""
    flags = cast(Any, ConfigStack).top_or_none()
    known = self.__dict__.setdefault("_gough_resolved", {})
    key = args, tuple(kws.items()), None if flags is None else repr(flags._values)
    if key not in known:
        signature = _resolve(self, context, args, kws)
        known[key] = signature, self._impl_keys.get(signature.args)
    signature, implementation = known[key]
    self._impl_keys[signature.args] = implementation
    return signature


def _stable_name(self: Any) -> tuple[str, tuple[int]]:
    """As `mangling_args` of a record, with a number that is the same in every process."""
    known = self.__dict__
    if "_gough_number" not in known:
        known["_gough_number"] = number_of(str(self))
    return "Record", (known["_gough_number"],)


def number_of(text: str) -> int:
    """A number that is the same in every process."""
    return int(hashlib.sha256(text.encode()).hexdigest()[:15], 16)


def _variables(self: Any, value: Any) -> list[Any]:
    """As `_rec_list_vars` of numba's instructions, which takes all apart that they consist of."""
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, list | tuple):
        value = (value,)
    found: list[Any] = []
    for each in value:
        kind: Any = type(each)
        if kind is Var:
            found.append(each)
        elif _may_hold_variables(kind):
            found.extend(each.list_vars() if issubclass(kind, Inst) else _variables(self, each))
    return found


@cache
def _may_hold_variables(kind: type) -> bool:
    return issubclass(kind, Inst | dict | list | tuple)


def _refresh_if_needed(self: Any) -> None:
    """Refresh only if a registry has grown since; numba installs some twenty of them again for each function."""
    registered = _registered(self)
    if self.__dict__.get("_gough_registered") != registered:
        _refresh(self)
        # The number from before: what is registered during a refresh needs another one.
        self._gough_registered = registered


def _registered(context: Any) -> int:
    """The number of items in the registries that are installed in a context and in its typing context."""
    loaders = {**context._registries, **context.typing_context._registries}
    return sum(len(getattr(registry, items)) for registry, loader in loaders.items() for items in loader.registry_items)


def _inline_closures_if_any(self: Any, state: Any) -> bool:
    """Run the pass only on a function that defines another one inside, or makes a list, as comprehensions do."""
    blocks = state.func_ir.blocks.values()
    any_made = any(True for block in blocks for made in ("make_function", "build_list") for _ in block.find_exprs(made))
    return any_made and bool(_inline_closures(self, state))


@register_jitable
def _refuse_shape(source: Any, target: Any) -> None:
    """In place of what puts two shapes into words: numba compiles its functions of texts into each assignment of an array."""
    raise ValueError("the shapes of an array and of what is assigned to it differ")


_SHORTCUTS: tuple[tuple[Any, str, Any], ...] = (
    (BaseFunction, "get_call_type", _resolve_once),
    (Record, "mangling_args", property(_stable_name)),
    # It is written for each of some 30 passes.
    (Record, "__repr__", cache(Record.__repr__)),
    (Inst, "_rec_list_vars", _variables),
    (InlineClosureLikes, "run_pass", _inline_closures_if_any),
    (CPUContext, "refresh", _refresh_if_needed),
    # With colorama, numba colours the text of every error, also of the hundred per function that it raises and catches itself.
    *(((_Colours, "_markup", lambda self, text, *style: text),) if hasattr(_Colours, "_markup") else ()),
    (arrayobj, "raise_with_shape_context", _refuse_shape),
    # The timers of each function that is being compiled are called at each of LLVM's functions.
    (event, "install_timer", lambda kind, callback: nullcontext()),
)
