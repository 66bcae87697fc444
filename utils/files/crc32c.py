"""CRC-32C (Castagnoli), the checksum of TensorBoard's event files."""

from functools import cache

import numpy as np

_POLYNOMIAL = 0x82F63B78  # of RFC 3720, bits reversed
_LANES = 1 << 10  # parts of long data that are read side by side; a power of two
_LONG = 4 * _LANES  # bytes; a loop is faster below


def crc32c(data: bytes) -> int:
    """Checksum of any bytes."""
    if len(data) >= _LONG:
        return _in_lanes(data)
    table, register = _as_numbers(), 0xFFFFFFFF
    for byte in data:
        register = table[(register ^ byte) & 0xFF] ^ (register >> 8)
    return register ^ 0xFFFFFFFF


def _in_lanes(data: bytes) -> int:
    """Checksum of at least 4 bytes.

    The register's change by a byte is linear in both, over bits. So the data is cut into lanes of one length, each
    starting with an empty register, and the registers are joined in pairs: the left one moves on by the bytes of the
    right one, as over zeros. Zeros in front of the data leave an empty register as it is, and fill the first lane.
    """
    content = np.frombuffer(data, np.uint8).copy()
    content[:4] ^= 0xFF  # the same as starting with a register of ones
    width = -(-len(content) // _LANES)
    padded = np.zeros(_LANES * width, np.uint8)
    padded[_LANES * width - len(content) :] = content
    columns, table = np.ascontiguousarray(padded.reshape(_LANES, width).T), _after_byte()
    register = np.zeros(_LANES, np.uint32)
    for column in columns:
        register = table[(register ^ column) & 0xFF] ^ (register >> 8)
    while len(register) > 1:
        register = _applied(_after_zeros(width), register[::2]) ^ register[1::2]
        width *= 2
    return int(register[0]) ^ 0xFFFFFFFF


@cache
def _after_byte() -> np.ndarray:
    """By the lowest byte of a register (256): the register after 8 bits, of which that byte is all."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(_POLYNOMIAL), table >> 1)
    return table


@cache
def _as_numbers() -> list[int]:
    return _after_byte().tolist()


@cache
def _after_zeros(count: int) -> np.ndarray:
    """By bit of a register (32): the register that this bit alone becomes over `count` zero bytes."""
    bits = np.uint32(1) << np.arange(32, dtype=np.uint32)
    if count == 1:
        return _after_byte()[bits & 0xFF] ^ (bits >> 8)
    half = _after_zeros(count // 2)
    doubled = _applied(half, half)
    return _applied(_after_zeros(1), doubled) if count % 2 else doubled


def _applied(images: np.ndarray, registers: np.ndarray) -> np.ndarray:
    """What registers (n) become if each of their bits becomes its image (32)."""
    result = np.zeros_like(registers)
    for bit, image in enumerate(images):
        result ^= np.where((registers >> np.uint32(bit)) & 1, image, np.uint32(0))
    return result
