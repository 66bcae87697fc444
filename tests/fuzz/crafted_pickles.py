"""Files of torch.save, by what they try: to run code, or to take memory or time out of proportion."""

import io
import random
import struct
import zipfile
from collections.abc import Callable

SECRET = "words of the file"  # must not reach a message

MARK, STOP, POP, DUP, NONE, TRUE, FALSE = b"(", b".", b"0", b"2", b"N", b"\x88", b"\x89"
TUPLE, TUPLE1, TUPLE2, EMPTY_TUPLE, LIST, DICT = b"t", b"\x85", b"\x86", b")", b"]", b"}"
APPEND, APPENDS, SETITEM, SETITEMS, REDUCE, BUILD, NEWOBJ = b"a", b"e", b"s", b"u", b"R", b"b", b"\x81"
PERSISTENT, PUT0, GET0 = b"Q", b"q\0", b"h\0"


def number(value: int) -> bytes:
    data = value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)
    return b"\x8a" + bytes([len(data)]) + data


def text(value: str) -> bytes:
    data = value.encode()
    return b"X" + struct.pack("<I", len(data)) + data


def name(module: str, attribute: str) -> bytes:
    return f"c{module}\n{attribute}\n".encode()


def tuple_of(*parts: bytes) -> bytes:
    return MARK + b"".join(parts) + TUPLE


def call(function: bytes, *arguments: bytes) -> bytes:
    return function + tuple_of(*arguments) + REDUCE


ORDERED = name("collections", "OrderedDict")


def storage(
    count: bytes = number(15), word: bytes = text("storage"), dtype: bytes = name("torch", "FloatStorage"),
    key: bytes = text("0"), location: bytes = text("cpu"), more: bytes = b"",
) -> bytes:  # fmt: skip
    return tuple_of(word, dtype, key, location, count, more) + PERSISTENT


def tensor(
    stored: bytes | None = None, offset: int = 0, size: tuple = (5, 3), stride: tuple = (3, 1), gradient: bytes = FALSE
) -> bytes:
    numbers = [tuple_of(*(number(value) for value in values)) for values in (size, stride)]
    hooks = call(ORDERED)
    stored = storage() if stored is None else stored
    return call(name("torch._utils", "_rebuild_tensor_v2"), stored, number(offset), *numbers, gradient, hooks)


def archive(parts: dict[str, bytes], **options: int) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", **options) as made:
        for part, content in parts.items():
            made.writestr(zipfile.ZipInfo(f"archive/{part}"), content, options.get("compression"), 1)
    return file.getvalue()


def old_format(pickle: bytes, keys: bytes | None = None, count: int = 15, magic: bytes | None = None) -> bytes:
    """A file as before torch 1.6."""
    keys = LIST + text("0") + APPEND if keys is None else keys
    magic = number(0x1950A86A20F9469CFC6C) if magic is None else magic
    pickles = (magic, number(1001), DICT, pickle, keys)
    return b"".join(b"\x80\x02" + part + STOP for part in pickles) + struct.pack("<q", count) + bytes(60)


def _file(rng: random.Random, part: bytes) -> bytes:
    """A file with this part: as a whole, in place of a checkpoint's iteration or extent, in either format."""
    place = rng.randrange(4)
    if place == 0:
        return old_format(part)
    if place == 1:
        radii, column = tensor(size=(5,), stride=(1,)), tensor(size=(5, 1), stride=(1, 1))
        part = tuple_of(number(1), *[tensor()] * 6, radii, column, column, DICT, part) + number(3) + TUPLE2
    elif place == 2:
        part = tuple_of(*[number(0)] * 12) + part + TUPLE2
    return archive({"data.pkl": b"\x80\x02" + part + STOP, "data/0": bytes(60), "version": b"3\n"})


def _dtype(code: str) -> bytes:
    return call(name("numpy", "dtype"), text(code), FALSE, TRUE)


def _encoded(data: str) -> bytes:
    return call(name("_codecs", "encode"), text(data), text("latin1"))


def _scalar(dtype: bytes, data: str = "ABCDEFGH") -> bytes:
    return call(name("numpy._core.multiarray", "scalar"), dtype, _encoded(data))


def _state(*parts: bytes) -> bytes:
    return tuple_of(number(3), text("<"), *parts, number(-1), number(-1), number(0)) + BUILD


def _object_pointer() -> bytes:
    """A float64 of NumPy whose dtype became one of objects: 8 bytes of the file as the address of an object."""
    within = _dtype("f8") + _state(tuple_of(_dtype("O8"), tuple_of(number(1))), NONE, NONE)
    fields = LIST + tuple_of(text("a"), within) + APPEND
    return _scalar(call(name("numpy", "dtype"), fields))


def _shared(levels: int, width: int, mutable: bool) -> bytes:
    part = LIST if mutable else EMPTY_TUPLE
    for _ in range(levels):
        items = MARK + part + PUT0 + GET0 * (width - 1)
        part = LIST + items + APPENDS if mutable else items + TUPLE
    return part


_DEEP = _shared(26, 2, False)

# Parts of pickles, each made with random numbers.
PARTS: dict[str, Callable[[random.Random], bytes]] = {
    "a dtype of objects by BUILD": lambda _: _object_pointer(),
    "a scalar of another dtype": lambda rng: _scalar(_dtype(rng.choice(["V1500000000", "O8", "U99999999", "i8"]))),
    "a scalar of too few bytes": lambda rng: _scalar(_dtype("f8"), "A" * rng.randrange(8)),
    "a swapped dtype": lambda _: _scalar(_dtype("f8") + _state(NONE, NONE, NONE).replace(text("<"), text(">"))),
    "a bytearray": lambda rng: call(name("builtins", "bytearray"), number(rng.choice([6_000_000_000, 2**40, 9]))),
    "other constructors": lambda rng: call(
        name("builtins", rng.choice(["set", "complex", "bytes", "list", "range"])), number(rng.randrange(2**33))
    ),
    "lists that share lists": lambda rng: _shared(rng.choice([8, 10, 40]), 8, True),
    "tuples that share tuples": lambda rng: _shared(rng.choice([26, 31, 200]), 2, False),
    "a key of shared tuples": lambda _: DICT + _DEEP + NONE + SETITEM,
    "a dtype named by shared tuples": lambda _: call(name("numpy", "dtype"), _DEEP, FALSE, TRUE),
    "a storage named by shared tuples": lambda _: tensor(storage(key=_DEEP)),
    "a storage of a word of shared tuples": lambda _: tensor(storage(word=_DEEP)),
    "bytes of shared tuples": lambda _: call(name("_codecs", "encode"), _DEEP, _DEEP),
    "deep tuples": lambda rng: EMPTY_TUPLE + TUPLE1 * rng.choice([40, 5000, 300_000]),
    "deep lists": lambda rng: LIST * 90_000 + APPEND * 89_999,
    "a list in itself": lambda _: LIST + PUT0 + GET0 + APPEND,
    "a dict in itself": lambda _: DICT + PUT0 + text("a") + GET0 + SETITEM,
    "a function of the system": lambda rng: call(
        name(*rng.choice([("os", "mkdir"), ("posix", "system"), ("builtins", "eval"), ("subprocess", "run")])),
        text(SECRET),
    ),
    "INST": lambda _: MARK + text(SECRET) + b"ios\nmkdir\n",
    "OBJ": lambda _: MARK + name("os", "mkdir") + text(SECRET) + b"o",
    "NEWOBJ_EX": lambda _: name("torch.nn.parameter", "Parameter") + EMPTY_TUPLE + DICT + b"\x92",
    "STACK_GLOBAL": lambda _: text("os") + text("mkdir") + b"\x93" + text(SECRET) + TUPLE1 + REDUCE,
    "EXT": lambda rng: rng.choice([b"\x82\1", b"\x83\1\0", b"\x84\1\0\0\0"]),
    "BUILD of a function": lambda _: name("_codecs", "encode") + DICT + text("__defaults__") + NONE + SETITEM + BUILD,
    "BUILD of a tensor": lambda rng: tensor() + tuple_of(storage(), number(2**40), tuple_of(), tuple_of()) + BUILD,
    "BUILD of a parameter": lambda rng: call(name("torch.nn.parameter", "Parameter"), tensor())
    + rng.choice([tuple_of(TRUE, FALSE, NONE), tuple_of(*[_DEEP] * 5), tuple_of(), DICT, tuple_of(text(SECRET))])
    + BUILD,
    "BUILD of a dict": lambda _: ORDERED + EMPTY_TUPLE + REDUCE + DICT + text("keys") + NONE + SETITEM + BUILD,
    "BUILD of a list": lambda _: LIST + tuple_of(NONE, DICT) + BUILD,
    "a large memo": lambda rng: NONE + b"r" + struct.pack("<I", rng.choice([2**31 - 1, 2**32 - 1, 2**28])),
    "a memo of many": lambda rng: b"".join(NONE + b"r" + struct.pack("<I", i * 4999) for i in range(60_000)),
    "an empty place of the memo": lambda _: b"j\xff\xff\xff\x7f",
    "MEMOIZE": lambda _: NONE + b"\x94" * 10_000,
    "a long integer": lambda rng: b"\x8b" + struct.pack("<i", rng.choice([2**31 - 1, -1, 2**20])) + b"\x7f" * 99,
    "an integer of 255 bytes": lambda _: b"\x8a\xff" + b"\x7f" * 255,
    "digits": lambda rng: rng.choice([b"I", b"L", b"F"]) + b"9" * rng.choice([4000, 3_000_000]) + b"\n",
    "a large frame": lambda rng: b"\x95" + struct.pack("<Q", rng.choice([2**63, 2**40, 2**64 - 1])),
    "a long text": lambda rng: rng.choice([b"X", b"T", b"B"]) + struct.pack("<I", rng.choice([2**31 - 1, 2**32 - 1])),
    "long bytes": lambda rng: rng.choice([b"\x8d", b"\x8e", b"\x96"]) + struct.pack("<Q", rng.choice([2**62, 2**34])),
    "a wide text": lambda _: b"X" + struct.pack("<I", 4_000_000) + b"a" * 3_999_996 + "\U0001f600".encode(),
    "surrogates": lambda _: b"X\3\0\0\0\xed\xa0\x80",
    "an id that is no tuple": lambda rng: tensor(rng.choice([text("storage"), NONE, DICT, _DEEP]) + PERSISTENT),
    "an id of too few parts": lambda _: tensor(tuple_of(text("storage"), name("torch", "FloatStorage")) + PERSISTENT),
    "another word": lambda rng: tensor(storage(word=rng.choice([text("module"), NONE, number(1)]))),
    "a storage of no dtype": lambda rng: tensor(
        storage(dtype=rng.choice([NONE, text("float"), name("torch._utils", "_rebuild_tensor")]))
    ),
    "another dtype": lambda rng: tensor(storage(dtype=name("torch", f"{rng.choice(['Double', 'Bool', 'Q'])}Storage"))),
    "a key of no part": lambda rng: tensor(
        storage(key=rng.choice([text("../data.pkl"), text("/etc/passwd"), text("7"), number(0), text(SECRET), LIST]))
    ),
    "a count of another size": lambda rng: tensor(
        storage(rng.choice([number(n) for n in (-1, 0, 14, 16, 2**31, 2**40, 2**62, 2**200)] + [NONE, TRUE, text("9")]))
    ),
    "a view of a storage": lambda _: tensor(storage(more=tuple_of(text("1"), number(2**40), number(2**40)))),
    "storages of the same bytes": lambda _: LIST + tensor() + APPEND + tensor(storage(number(7))) + APPEND,
    "an offset": lambda rng: tensor(offset=rng.choice([1, -1, 2**31, 2**62, 2**63, 2**70])),
    "a size": lambda rng: tensor(size=(rng.choice([-1, 6, 2**31, 2**62, 2**70]), rng.choice([3, 0, -3]))),
    "a stride": lambda rng: tensor(stride=(rng.choice([-1, 4, 2**31, 2**62, 2**70]), rng.choice([1, 0, -1]))),
    "a size of nothing": lambda rng: tensor(size=(0, 2**47, 2**47, 2**47), stride=(1, 1, 1, 1)),
    "many dimensions": lambda rng: tensor(size=(1,) * rng.choice([9, 65, 20_000]), stride=(1,) * 65),
    "repeated values": lambda rng: tensor(size=(rng.choice([6, 2**31, 2**44]), 3), stride=(0, 1)),
    "sizes of other types": lambda rng: tensor().replace(number(5), rng.choice([TRUE, NONE, b"G" + bytes(8), _DEEP])),
    "a gradient of integers": lambda _: tensor(storage(dtype=name("torch", "IntStorage")), gradient=TRUE),
    "a gradient of something": lambda rng: tensor(gradient=rng.choice([NONE, number(2), text("x"), _DEEP])),
    "a parameter of something": lambda rng: name("torch.nn.parameter", "Parameter")
    + tuple_of(rng.choice([LIST, NONE, storage(), _DEEP]))
    + rng.choice([NEWOBJ, REDUCE]),
    "another name of torch": lambda rng: call(
        name("torch._utils", rng.choice(["_rebuild_sparse_tensor", "_rebuild_wrapper_subclass", "_rebuild_qtensor"])),
        *[tensor()] * rng.randrange(8),
    ),
    "a type of torch": lambda rng: call(name("torch", rng.choice(["Tensor", "Size", "FloatStorage"])), number(2**34)),
    "bytes many times": lambda _: text("a" * 1_000_000) + PUT0
    + (name("_codecs", "encode") + GET0 + text("latin1") + TUPLE2 + REDUCE) * 5000,
    "dicts many times": lambda _: LIST + MARK + (text("k") + number(1) + TUPLE2) * 20_000 + APPENDS + PUT0
    + (ORDERED + GET0 + TUPLE1 + REDUCE) * 5000,
    "keys of one hash": lambda _: DICT + MARK
    + b"".join(number(i * (2**61 - 1)) + NONE for i in range(30_000)) + SETITEMS,
    "keys of other kinds": lambda rng: DICT + rng.choice([NONE, TRUE, tensor(), EMPTY_TUPLE]) + NONE + SETITEM,
    "many dicts": lambda _: DICT * 4_000_000,
    "many marks": lambda _: MARK * 4_000_000,
    "many tensors": lambda _: LIST + MARK + tensor() + b"".join(tensor() for _ in range(6000)) + APPENDS,
    "an underflow": lambda rng: rng.choice([POP, TUPLE, TUPLE2, APPEND, SETITEMS, REDUCE, BUILD, PUT0, PERSISTENT]),
    "DUP": lambda _: LIST + DUP * 1000 + APPEND * 1000,
    "two results": lambda _: NONE + NONE,
    "no STOP": lambda _: b"K",
    "another object": lambda rng: rng.choice([name("torch", "FloatStorage"), storage(), _dtype("f8"), _encoded("x")]),
    "words": lambda _: text(f"\x1b[31m{SECRET}\n"),
}  # fmt: skip

_SOUND = b"\x80\x02" + tensor() + STOP


def _overlapping(rng: random.Random) -> bytes:
    """Many entries of the directory for the same part."""
    whole = archive({"data.pkl": _SOUND, "data/0": bytes(1 << 20)})
    start = whole.rindex(b"PK\x01\x02")
    end = whole.rindex(b"PK\x05\x06")
    count = rng.choice([40, 9000])
    entries = b"".join(whole[start:end].replace(b"data/0", b"data/%x" % (i % 16)) for i in range(count))
    tail = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, count + 1, count + 1, start + len(entries), 0, 0)
    first = whole.index(b"PK\x01\x02")
    directory = whole[first:start] + entries
    return whole[:first] + directory + tail[:12] + struct.pack("<IIH", len(directory), first, 0)


def _large_numbers(rng: random.Random) -> bytes:
    """Sizes and places in the directory that the file does not have."""
    whole = bytearray(archive({"data.pkl": _SOUND, "data/0": bytes(60)}))
    entry = whole.rindex(b"PK\x01\x02")
    place = rng.choice([entry + 20, entry + 24, entry + 42, whole.rindex(b"PK\x05\x06") + rng.choice([8, 12, 16])])
    whole[place : place + 4] = struct.pack("<I", rng.choice([2**32 - 1, 2**31, 2**30, 61]))
    return bytes(whole)


# Whole files.
FILES: dict[str, Callable[[random.Random], bytes]] = {
    "a compressed part": lambda _: archive(
        {"data.pkl": _SOUND, "data/0": bytes(300 << 20)}, compression=zipfile.ZIP_DEFLATED
    ),
    "parts over each other": _overlapping,
    "large numbers in the directory": _large_numbers,
    "many parts": lambda _: archive({"data.pkl": _SOUND, "data/0": bytes(60)} | {str(i): b"" for i in range(12_000)}),
    "a long pickle": lambda _: archive({"data.pkl": b"\x80\x02" + NONE * (20 << 20) + STOP}),
    "no pickle": lambda _: archive({"data/0": bytes(60)}),
    "no part": lambda _: b"PK\3\4" + archive({}),
    "the other byte order": lambda rng: archive(
        {"data.pkl": _SOUND, "data/0": bytes(60), "byteorder": rng.choice([b"big", b"", bytes(1 << 20)])}
    ),
    "a TorchScript": lambda _: archive({"data.pkl": _SOUND, "constants.pkl": _SOUND, "code/__torch__.py": b""}),
    "another magic number": lambda rng: old_format(NONE, magic=rng.choice([NONE, _DEEP, number(7), b"K" * 99])),
    "storages of no key": lambda rng: old_format(tensor(), rng.choice([LIST, NONE, DICT, LIST + _DEEP + APPEND])),
    "a count beside the values": lambda rng: old_format(tensor(), count=rng.choice([-1, 0, 14, 2**62])),
    "a storage of the old format": lambda rng: old_format(tensor(storage(number(rng.choice([16, 2**31, 2**45]))))),
    "storages of the old format": lambda _: old_format(
        LIST + b"".join(tensor(storage(number(10), key=text(str(i)))) + APPEND for i in range(3000))
    ),
    "a short file": lambda rng: old_format(tensor())[: -rng.randint(1, 200)],
}  # fmt: skip

CRAFTED = {**{what: lambda rng, part=part: _file(rng, part(rng)) for what, part in PARTS.items()}, **FILES}
