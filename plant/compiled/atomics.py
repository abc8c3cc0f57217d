"""Loads and stores in a fixed order, for processes that share memory without locks."""

from typing import Any

from numba import types
from numba.extending import intrinsic


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
"""Kernel (array, index, value): store in a shared int64 array after all that was stored before."""

load_acquire: Any = intrinsic(_load)
"""Kernel (array, index): load from a shared int64 array before all that is loaded after."""

fence: Any = intrinsic(_fence)
"""Kernel (): keep what is loaded and stored before apart from what comes after."""
