"""Bytes that get lost or changed on a line."""

import random


class ByteNoise:
    """Drops and corrupts single bytes at random; a `Fault` of either direction of a bus.

    Attributes:
        drop: probability that a byte is lost.
        corrupt: probability that a byte arrives changed.
    """

    def __init__(self, drop: float = 0.0, corrupt: float = 0.0, seed: int = 0) -> None:
        self.drop = drop
        self.corrupt = corrupt
        self._rng = random.Random(seed)  # noqa: S311 - reproducible faults, not a secret

    def __call__(self, data: bytes) -> bytes:
        """What arrives of `data`."""
        out = bytearray()
        for byte in data:
            lot = self._rng.random()
            if lot < self.drop:
                continue
            out.append(byte ^ self._rng.randrange(1, 256) if lot < self.drop + self.corrupt else byte)
        return bytes(out)
