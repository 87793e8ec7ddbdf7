"""Damages to datagrams."""

from __future__ import annotations

import random
from collections.abc import Callable

Mutation = Callable[[random.Random, bytes, bytes], bytes]


def flip(noise: random.Random, data: bytes, other: bytes) -> bytes:
    flipped = int.from_bytes(data, "big") ^ 1 << noise.randrange(8 * len(data))
    return flipped.to_bytes(len(data), "big")


def cut(noise: random.Random, data: bytes, other: bytes) -> bytes:
    return data[: noise.randrange(len(data))]


def splice(noise: random.Random, data: bytes, other: bytes) -> bytes:
    return data[: noise.randrange(len(data))] + other[noise.randrange(len(other)) :]


def join(noise: random.Random, data: bytes, other: bytes) -> bytes:
    return data + other


def pad(noise: random.Random, data: bytes, other: bytes) -> bytes:
    return data + bytes(noise.randrange(64))


def trim(noise: random.Random, data: bytes, other: bytes) -> bytes:
    return data.rstrip(b"\0")


def relength(noise: random.Random, data: bytes, other: bytes) -> bytes:
    """Change one of the first three bytes: the tag or the length."""
    at = noise.randrange(min(3, len(data)))
    return data[:at] + bytes((noise.randrange(256),)) + data[at + 1 :]


def insert(noise: random.Random, data: bytes, other: bytes) -> bytes:
    at = noise.randrange(len(data))
    return data[:at] + noise.randbytes(noise.randrange(1, 9)) + data[at:]


def garbage(noise: random.Random, data: bytes, other: bytes) -> bytes:
    return noise.randbytes(noise.randrange(128))


def same(noise: random.Random, data: bytes, other: bytes) -> bytes:
    return data


MUTATIONS: tuple[Mutation, ...] = (flip, flip, cut, splice, join, pad, trim, relength, insert, garbage, same)
