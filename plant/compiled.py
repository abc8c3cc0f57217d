"""Compiled kernels: the one decorator that marks them, and where their machine code is kept.

numba notices an edit in the file of a kernel but not in the files of its callees, and an installed package may lie in a
folder that cannot be written. The cache therefore lives in the user's cache folder under a hash of every source file of
the three packages: any edit gives a new folder, and the old ones are swept away when they have not been used for a month.
"""

import atexit
import hashlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import types
from numba.extending import intrinsic, lower_cast

F = TypeVar("F", bound=Callable[..., Any])

Record = Any
"""A structured array of shape () or (N,). Compiled code reads its fields as attributes of `record[()]`, which the types of
NumPy cannot say."""

PACKAGES = ("plant", "controller", "hil")
STALE_AFTER_S = 30 * 24 * 3600.0


def user_cache() -> Path:
    """The folder for what gough builds on demand: `$GOUGH_CACHE`, else `gough` in the user's cache folder."""
    if configured := os.environ.get("GOUGH_CACHE"):
        return Path(configured)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gough"


def hash_of_files(files: Iterable[Path], *extra: str) -> str:
    """Twenty hexadecimal digits that change with the content of any of the files, or with `extra`."""
    digest = hashlib.sha256("\0".join(extra).encode())
    for file in files:
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:20]


def keyed_folder(kind: str, key: str) -> Path:
    """The cache folder of this kind and key, made and marked as used; folders long unused are removed.

    Where the user's cache cannot be written, the folder lasts only as long as the process.
    """
    try:
        folder = user_cache() / kind / key
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
    except (OSError, RuntimeError):
        # RuntimeError: there is no home folder.
        folder = _passing_cache() / kind / key
        folder.mkdir(parents=True, exist_ok=True)
        return folder
    for other in folder.parent.iterdir():
        with suppress(OSError):
            if other != folder and time.time() - other.stat().st_mtime > STALE_AFTER_S:
                shutil.rmtree(other, ignore_errors=True)
    return folder


@cache
def _passing_cache() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="gough-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@cache
def _kernel_folder() -> Path:
    root = Path(__file__).resolve().parent.parent
    sources = sorted(file for package in PACKAGES for file in (root / package).rglob("*.py"))
    return keyed_folder("kernels", hash_of_files(sources, numba.__version__))


def kernel(function: F) -> F:
    """Mark a function of the cycle: compiled, off the GIL, never raising, its machine code cached.

    Division by zero gives inf or NaN as in NumPy, and fastmath stays off so that NaN checks mean something. By itself numba
    compiles a function anew for each constant that it is called with, and for each shape of a record's array. Compiling it
    once for all of them saves a third of a cold start.
    """
    settings: Any = numba.config
    before = settings.CACHE_DIR
    settings.CACHE_DIR = str(_kernel_folder())
    try:
        compiled: Any = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    finally:
        settings.CACHE_DIR = before
    template = compiled.get_call_template
    compiled.get_call_template = lambda args, kws: template(
        tuple(_general(each) for each in args), {name: _general(each) for name, each in kws.items()}
    )
    return cast(F, compiled)


def _general(kind: Any) -> Any:
    """The type of an argument without its value, of a member of an enumeration as its number, of a record's array without its
    shape.
    """
    general: Any = cast(Any, types.unliteral)(kind)
    if isinstance(general, types.IntEnumMember):
        return general.dtype
    return types.Array(general.dtype, general.ndim, "C") if isinstance(general, types.NestedArray) else general


@lower_cast(types.NestedArray, types.Array)  # type: ignore[no-untyped-call, untyped-decorator]
def _cast_nested(context: Any, builder: Any, from_type: Any, to_type: Any, value: Any) -> Any:
    """Pass a record's array on as it is: numba has no such cast, though both lie in memory alike."""
    return value


def _store(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        held = context.make_array(signature.args[0])(context, builder, arguments[0])
        builder.store_atomic(arguments[2], builder.gep(held.data, [arguments[1]]), "release", 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.int64), generate


def _load(typing_context: Any, array: Any, index: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        held = context.make_array(signature.args[0])(context, builder, arguments[0])
        return builder.load_atomic(builder.gep(held.data, [arguments[1]]), "acquire", 8)

    return types.int64(array, types.intp), generate


def _fence(typing_context: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.fence("acq_rel")
        return context.get_dummy_value()

    return types.void(), generate


store_release: Any = intrinsic(_store)
"""Kernel (array, index, value): store a number in a shared int64 array (n,) after everything that was stored before it."""

load_acquire: Any = intrinsic(_load)
"""Kernel (array, index): load a number of a shared int64 array (n,) before everything that is loaded after it."""

fence: Any = intrinsic(_fence)
"""Kernel (): keep what is loaded and stored before apart from what is stored after, and what is loaded before from after."""
