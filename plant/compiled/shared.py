"""Kernels with machine code of their own, which their callers share, and may know before it is there."""

import inspect
import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, cast

from llvmlite.binding import add_symbol
from numba.core.bytecode import FunctionIdentity
from numba.core.compiler import Flags, compile_result
from numba.core.compiler_lock import global_compiler_lock
from numba.core.funcdesc import PythonFunctionDescriptor
from numba.core.types import boolean, float64, int64, none
from numba.core.typing.templates import signature

from plant.compiled.linking import FlatLibrary, flat_linking, linked_flat
from plant.compiled.shortcuts import number_of


def linked_shared(dispatcher: Any) -> Callable[[Any], Any]:
    """The `compile` of a dispatcher whose machine code is shared by its callers: with flat linking, and a name in the machine
    code that is the same in every process.

    Raises:
        TypeError: the function does not say what it returns.
    """
    compile_flat = linked_flat(dispatcher.compile)
    function, overloads = dispatcher.py_func, dispatcher.overloads
    if function.__annotations__.get("return", ...) not in _RETURNED:
        raise TypeError(f"annotate what {function.__qualname__} returns by None, bool, int or float: its callers need to know")
    identities: Any = FunctionIdentity

    def compile_shared(types: Any) -> Any:
        arguments = tuple(types)
        if arguments in overloads:
            return overloads[arguments].entry_point
        with global_compiler_lock:
            if _is_elsewhere is not None and _is_elsewhere(dispatcher, arguments):
                overloads[arguments] = _declared(dispatcher, arguments)
                return overloads[arguments].entry_point
            others = identities._unique_ids
            identities._unique_ids = itertools.chain((_number_of_kernel(function),), others)
            try:
                entry = compile_flat(arguments)
            finally:
                identities._unique_ids = others
            overloads[arguments].library.origin = function.__module__, function.__qualname__, arguments
            if _is_elsewhere is not None:
                _check_description(dispatcher, arguments)
        return entry

    return compile_shared


def _number_of_kernel(function: Any) -> int:
    return number_of(f"{function.__module__}.{function.__qualname__}")


_is_elsewhere: Callable[[Any, tuple[Any, ...]], bool] | None = None


@contextmanager
def shared_kernels_declared(is_elsewhere: Callable[[Any, tuple[Any, ...]], bool]) -> Iterator[None]:
    """Compile callers of shared kernels without these, where a function of the kernel and the types of its arguments says that
    another process compiles it. What is compiled meanwhile cannot be run here.
    """
    global _is_elsewhere
    _is_elsewhere = is_elsewhere
    try:
        with flat_linking():
            yield
    finally:
        _is_elsewhere = None


_RETURNED = {None: none, bool: boolean, int: int64, float: float64}
"""Types of what shared kernels return, by their annotations."""


def _declared(dispatcher: Any, arguments: tuple[Any, ...]) -> Any:
    """What numba keeps of a compiled function, as far as callers need it, of a kernel that is compiled elsewhere."""
    description, context = described(dispatcher, arguments), dispatcher.targetctx
    library = FlatLibrary(context.codegen(), description.mangled_name)
    library.origin, library._finalized = (description.modname, description.qualname, arguments), True
    # At this address there is no function, as nothing is run.
    add_symbol(description.mangled_name, 1)
    entry, make_overload, make_signature = object(), cast(Any, compile_result), cast(Any, signature)
    context.insert_user_function(entry, description, [library])
    return make_overload(
        entry_point=entry,
        signature=make_signature(description.restype, *arguments),
        fndesc=description,
        library=library,
        objectmode=False,
    )


def described(dispatcher: Any, arguments: tuple[Any, ...]) -> Any:
    """The name in machine code, and the types, of a shared kernel that need not be compiled."""
    function, flags, describe = dispatcher.py_func, cast(Any, Flags)(), cast(Any, PythonFunctionDescriptor)
    dispatcher.targetdescr.options.parse_as_flags(flags, dispatcher.targetoptions)
    return describe(
        native=True,
        modname=function.__module__,
        qualname=function.__qualname__,
        unique_name=function.__qualname__,
        doc="",
        typemap=None,
        restype=_RETURNED[function.__annotations__["return"]],
        calltypes=None,
        args=tuple(inspect.signature(function).parameters),
        kws=(),
        mangler=dispatcher.targetctx.mangler,
        argtypes=arguments,
        abi_tags=[flags.get_mangle_string()],
        uid=_number_of_kernel(function),
    )


def _check_description(dispatcher: Any, arguments: tuple[Any, ...]) -> None:
    """Raise an error if a kernel is compiled otherwise than its callers elsewhere expect it."""
    compiled, expected = dispatcher.overloads[arguments].fndesc, described(dispatcher, arguments)
    for name in ("mangled_name", "restype"):
        if getattr(compiled, name) != getattr(expected, name):
            raise TypeError(f"{dispatcher} has the {name} {getattr(compiled, name)}, not {getattr(expected, name)}")
