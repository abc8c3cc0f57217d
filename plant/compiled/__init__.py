"""Compiled kernels: the decorator, the order of shared memory, and where machine code is kept."""

from plant.compiled.atomics import fence, load_acquire, store_release
from plant.compiled.cache import hash_of_files, keyed_folder, user_cache
from plant.compiled.kernels import Record, compilation_reported, filled, kernel, record_dtype, shared_kernel
from plant.compiled.limits import MOST, Limits, out_of_limits
from plant.compiled.processes import load_kernels

__all__ = [
    "MOST",
    "Limits",
    "Record",
    "compilation_reported",
    "fence",
    "filled",
    "hash_of_files",
    "kernel",
    "keyed_folder",
    "load_acquire",
    "load_kernels",
    "out_of_limits",
    "record_dtype",
    "shared_kernel",
    "store_release",
    "user_cache",
]
