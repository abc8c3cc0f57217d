"""Faster compilation: kernels are linked once, flat, instead of at every level of calls, or not at all into their callers.

This module replaces parts of numba while a kernel compiles.
"""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from importlib import import_module
from types import SimpleNamespace
from typing import Any

from llvmlite.binding import Linkage, parse_assembly
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.core.environment import lookup_environment
from numba.core.registry import cpu_target

from plant.compiled.shortcuts import shortcuts_taken

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
        library = super()._unserialize(codegen, (name, kind, (machine_code, stub)))
        library.calls = calls
        return library


def _weaken(module: Any, which: Callable[[str], bool]) -> None:
    """Let functions be dropped when nothing calls them, and be defined in several modules."""
    for each in module.functions:
        if not each.is_declaration and each.linkage == Linkage.external and which(each.name):
            each.linkage = "linkonce_odr"


_NO_ENVIRONMENTS = SimpleNamespace(set_env=lambda name, environment: None)
_MANGLED, _WRAPPER, _ENVIRONMENT = "_ZN", "_ZN7cpython", "_ZN08NumbaEnv"
_depth = 0


@contextmanager
def flat_linking() -> Iterator[None]:
    """Link flat what numba compiles meanwhile."""
    global _depth
    # numba's own runtime must not be linked flat: build it first.
    cpu_target.target_context.refresh()
    codegen: Any = cpu_target.target_context.codegen()
    _depth += 1
    try:
        with shortcuts_taken() if _depth == 1 else nullcontext():
            codegen._library_class = FlatLibrary
            yield
    finally:
        _depth -= 1
        if _depth == 0:
            codegen._library_class = JITCodeLibrary


@contextmanager
def _ctrl_c_kept() -> Iterator[None]:
    """Let no Ctrl-C be lost: its exception ends in the function that LLVM calls back, so it is raised once more. Python reports
    the first one as ignored, with a traceback, which is left out.
    """
    before, main = signal.getsignal(signal.SIGINT), threading.current_thread() is threading.main_thread()
    if not main or before is not signal.default_int_handler:
        yield
        return
    pressed: list[int] = []
    report = sys.unraisablehook

    def report_others(unraisable: "sys.UnraisableHookArgs") -> None:
        if unraisable.exc_type is not KeyboardInterrupt:
            report(unraisable)

    def press(number: int, frame: Any) -> None:
        pressed.append(number)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, press)
    sys.unraisablehook = report_others
    try:
        yield
    finally:
        sys.unraisablehook = report
        signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt


def linked_flat(compile_kernel: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """The `compile` of a dispatcher, with flat linking."""

    def compile_flat(signature: Any) -> Any:
        with _ctrl_c_kept(), global_compiler_lock, flat_linking():
            return compile_kernel(signature)

    return compile_flat
