"""Bound on the rows of a compressed file, so that a few bytes do not ask for all memory."""

_FREE = 1 << 16  # rows that any file may have: some 50 MB as splats


def check_packed_rows(count: int, size: int) -> None:
    """ValueError if a compressed file of `size` bytes promises more splats or points than honest ones have.

    Beyond 65,536 it may have one for each byte: trained splats take 10 bytes or more, and a lattice of equal ones, as
    well as one can compress it, 0.95.
    """
    if count > size + _FREE:
        raise ValueError(f"it promises {count:,} rows in {size:,} bytes, which no honest file does")
