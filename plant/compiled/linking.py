"""Faster compilation: kernels are linked once, flat, instead of at every level of calls, or not at all into their callers.

This module replaces parts of numba while a kernel compiles. It halves the first start on a machine, and more loops than one
share the machine code of the cycle.
"""

import gc
import hashlib
import inspect
import itertools
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from types import SimpleNamespace
from typing import Any, cast

from llvmlite.binding import Linkage, add_symbol, parse_assembly
from numba.core.bytecode import FunctionIdentity
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Flags, compile_result
from numba.core.compiler_lock import global_compiler_lock
from numba.core.environment import lookup_environment
from numba.core.funcdesc import PythonFunctionDescriptor
from numba.core.registry import cpu_target
from numba.core.targetconfig import ConfigStack
from numba.core.types import Record, boolean, float64, int64, none
from numba.core.types.functions import BaseFunction
from numba.core.typing.templates import signature

Origin = tuple[str, str, tuple[Any, ...]]
"""Module, name and types of arguments of a kernel."""

_Library: Any = JITCodeLibrary
_environment_of: Any = lookup_environment


class FlatLibrary(_Library):  # type: ignore[misc]
    """The code of one function: machine code if Python calls it or callers share it, else only bitcode, which is linked into
    its callers.

    numba itself links and optimises each function with all its callees, again at every level; here it is done once. The
    arithmetic does not depend on it, because fastmath is off.
    """

    inner = False
    origin: Origin | None = None
    """Where a shared kernel comes from."""

    calls: tuple[Origin, ...] = ()
    """The origins of the shared kernels that this code calls: they must be loaded with it."""

    _shared_module: Any = None

    @property
    def codegen(self) -> Any:
        """Where numba sets the environments of functions."""
        return _NO_ENVIRONMENTS if self.inner else self._codegen

    def finalize(self) -> None:
        """Link, optimise and load a function that Python calls; leave any other as it is."""
        self._raise_if_finalized()
        module = self._final_module
        self.inner = not any(each.name.startswith(_WRAPPER) for each in module.functions)
        # numba writes some helpers into several modules under one name.
        _weaken(module, lambda name: not name.startswith(_MANGLED))
        if self.inner:
            self._finalized = True
            return
        self._link_callees(module)
        self._optimize_final_module()
        module.verify()
        self._finalize_final_module()
        for each in module.global_variables:
            if each.name.startswith(_ENVIRONMENT) and (environment := _environment_of(each.name)) is not None:
                self._codegen.set_env(each.name, environment)

    def _link_callees(self, module: Any) -> None:
        inner: dict[Any, None] = {}
        others: dict[Any, None] = {}
        to_do = list(self._linking_libraries)
        while to_do:
            each = to_do.pop()
            if not getattr(each, "inner", False):
                others[each] = None
            elif each not in inner:
                inner[each] = None
                to_do.extend(each._linking_libraries)
        self.calls = tuple({each.origin: None for each in others if getattr(each, "origin", None) is not None})
        own = {each.name for each in module.functions if not each.is_declaration}
        for each in inner:
            module.link_in(each._final_module, preserve=True)
        # A weak function is linked only where a function that is there already calls it, so these come last.
        for each in others:
            if getattr(each, "origin", None) is None:
                module.link_in(each._get_module_for_linking(), preserve=True)
        # numba 0.68 has it, 0.62 does not.
        for each in (*inner, *others):
            if hasattr(self, "_reload_init"):
                self._reload_init.update(each._reload_init)
        _weaken(module, lambda name: name not in own)

    def _get_module_for_linking(self) -> Any:
        """The module with all callees, for a caller that is not a kernel; an empty one if the code is shared."""
        self._ensure_finalized()
        if self.origin is not None:
            return parse_assembly("")
        if self.inner and self._shared_module is None:
            module = self._final_module.clone()
            self._link_callees(module)
            _weaken(module, lambda name: True)
            self._shared_module = module
        return super()._get_module_for_linking()

    def serialize_using_object_code(self) -> Any:
        """As numba, with names instead of bitcode: nothing links what Python calls."""
        self._ensure_finalized()
        names = [each.name for each in self._final_module.functions if not each.is_declaration]
        stub = parse_assembly("\n".join(f'define void @"{name}"() {{ ret void }}' for name in names))
        return self.name, "object", (self._get_compiled_object(), stub.as_bitcode(), self.calls)

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> Any:
        """As numba, after the shared kernels that the code calls."""
        name, kind, (machine_code, stub, calls) = state
        for module, kernel, arguments in calls:
            getattr(import_module(module), kernel).compile(arguments)
        return super()._unserialize(codegen, (name, kind, (machine_code, stub)))


def _weaken(module: Any, which: Callable[[str], bool]) -> None:
    """Let functions be dropped when nothing calls them, and be defined in several modules."""
    for each in module.functions:
        if not each.is_declaration and each.linkage == Linkage.external and which(each.name):
            each.linkage = "linkonce_odr"


_NO_ENVIRONMENTS = SimpleNamespace(set_env=lambda name, environment: None)
_MANGLED, _WRAPPER, _ENVIRONMENT = "_ZN", "_ZN7cpython", "_ZN08NumbaEnv"
_LAZY_COLLECTION = (50_000, 20, 20)
_resolve: Any = BaseFunction.get_call_type


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
        known["_gough_number"] = _number_of(str(self))
    return "Record", (known["_gough_number"],)


def _number_of(text: str) -> int:
    return int(hashlib.sha256(text.encode()).hexdigest()[:15], 16)


_mangling_args: Any = Record.mangling_args
_depth = 0


@contextmanager
def flat_linking() -> Iterator[None]:
    """Link flat what numba compiles meanwhile."""
    global _depth
    # numba's own runtime must not be linked flat: build it first.
    cpu_target.target_context.refresh()
    codegen: Any = cpu_target.target_context.codegen()
    collection, functions = gc.get_threshold(), cast(Any, BaseFunction)
    records: Any = Record
    _depth += 1
    if _depth == 1:
        codegen._library_class, functions.get_call_type = FlatLibrary, _resolve_once
        records.mangling_args = property(_stable_name)
        # Collecting the many small objects as often as usual would take a third of the time.
        gc.set_threshold(*_LAZY_COLLECTION)
    try:
        yield
    finally:
        _depth -= 1
        if _depth == 0:
            codegen._library_class, functions.get_call_type = JITCodeLibrary, _resolve
            records.mangling_args = _mangling_args
            gc.set_threshold(*collection)


@contextmanager
def _ctrl_c_kept() -> Iterator[None]:
    """Let no Ctrl-C be lost: its exception ends in the function that LLVM calls back, so it is raised once more."""
    before, main = signal.getsignal(signal.SIGINT), threading.current_thread() is threading.main_thread()
    if not main or before is not signal.default_int_handler:
        yield
        return
    pressed: list[int] = []

    def press(number: int, frame: Any) -> None:
        pressed.append(number)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, press)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt


def linked_flat(compile_kernel: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The `compile` of a dispatcher, with flat linking."""

    def compile_flat(signature: Any) -> Any:
        with _ctrl_c_kept(), global_compiler_lock, flat_linking():
            return compile_kernel(signature)

    return compile_flat


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
    return _number_of(f"{function.__module__}.{function.__qualname__}")


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
