"""Compiled kernels: the decorator, the order of shared memory, and where machine code is kept."""

from plant.compiled.atomics import fence, load_acquire, store_release
from plant.compiled.cache import hash_of_files, keyed_folder, user_cache
from plant.compiled.kernels import Record, compilation_reported, filled, kernel, record_dtype

__all__ = [
    "Record",
    "compilation_reported",
    "fence",
    "filled",
    "hash_of_files",
    "kernel",
    "keyed_folder",
    "load_acquire",
    "record_dtype",
    "store_release",
    "user_cache",
]
