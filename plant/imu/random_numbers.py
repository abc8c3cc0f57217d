"""Random numbers that are keyed by (seed, IMU, cycle), so that every cycle can be reproduced on its own."""

import numpy as np

from plant.compiled import kernel
from plant.pose import Array

Word = np.uint64 | int
"""A 32-bit number, kept in 64 bits."""


@kernel
def philox(c0: Word, c1: Word, c2: Word, c3: Word, k0: Word, k1: Word) -> tuple[Word, Word, Word, Word]:
    """Philox4x32-10 of Salmon, Moraes, Dror, Shaw (2011): four random 32-bit words for a counter and a key."""
    mask = np.uint64(0xFFFFFFFF)
    a, b, c, d = np.uint64(c0), np.uint64(c1), np.uint64(c2), np.uint64(c3)
    key0, key1 = np.uint64(k0), np.uint64(k1)
    for _ in range(10):
        product0 = np.uint64(0xD2511F53) * a
        product1 = np.uint64(0xCD9E8D57) * c
        a, c = (product1 >> np.uint64(32)) ^ b ^ key0, (product0 >> np.uint64(32)) ^ d ^ key1
        b, d = product1 & mask, product0 & mask
        key0 = (key0 + np.uint64(0x9E3779B9)) & mask
        key1 = (key1 + np.uint64(0xBB67AE85)) & mask
    return a, b, c, d


@kernel
def _normal_pair(word0: Word, word1: Word) -> tuple[float, float]:
    """Two standard normal numbers of two 32-bit words (Box and Muller)."""
    radius = np.sqrt(-2.0 * np.log((np.float64(word0) + 1.0) * 2.0**-32))
    angle = np.float64(word1) * (2.0 * np.pi * 2.0**-32)
    return radius * np.cos(angle), radius * np.sin(angle)


@kernel
def draw_normals(normals: Array, cycle: int, imu: int, purpose: int, seed: int) -> float:
    """Fill `normals` (6,) with standard normal numbers; returns a further number, uniform in [0, 1)."""
    mask = np.uint64(0xFFFFFFFF)
    key0, key1 = np.uint64(seed) & mask, np.uint64(seed) >> np.uint64(32)
    low, high = np.uint64(cycle) & mask, np.uint64(cycle) >> np.uint64(32)
    a, b, c, d = philox(low, high, imu, 2 * purpose, key0, key1)
    normals[0], normals[1] = _normal_pair(a, b)
    normals[2], normals[3] = _normal_pair(c, d)
    a, b, c, d = philox(low, high, imu, 2 * purpose + 1, key0, key1)
    normals[4], normals[5] = _normal_pair(a, b)
    return np.float64(c) * 2.0**-32
