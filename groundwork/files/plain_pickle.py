"""Pickles of plain values, read by a machine that can make nothing else.

A pickle is a program: Python's unpickler imports and calls whatever a file names. This machine knows some thirty
operations, calls only functions that its caller gives, and stops a program or a result that is too large.
"""

import pickletools
from collections.abc import Callable, Mapping
from types import FunctionType
from typing import Any, BinaryIO

MOST_BYTES = 4 << 20  # of a pickle; its texts take at most four times as much memory
_MOST_OPERATIONS = 200_000  # of a machine in all; a tensor takes about 30
_MOST_VALUES, _DEEPEST = 100_000, 32  # of a result; what stands in two places counts twice
_PLAIN = (type(None), bool, int, float, str)


class Machine:
    """Reads pickles of protocol 2 as torch writes them.

    names: the value of each "module name" that a file may use; a function among them is called with the file's
    arguments, which can have any type.
    persistent: called with a persistent id of the file, returns its value.
    build: called with an object and the state that the file gives it.
    leaves: types that a result may hold besides numbers, text, lists, tuples and dicts.
    """

    def __init__(
        self,
        names: Mapping[str, Any],
        persistent: Callable[[Any], Any],
        build: Callable[[Any, Any], None],
        leaves: tuple[type, ...] = (),
    ) -> None:
        """Prepare to read pickles.

        names: values that a pickle may name. persistent: gives the value of a persistent id. build: sets the state of a
        value. leaves: types that values may have besides plain ones.
        """
        self._names, self._persistent, self._build = names, persistent, build
        self._leaves = {*_PLAIN, *leaves}
        self._left = _MOST_OPERATIONS

    def read(self, file: BinaryIO) -> Any:
        """The content of a pickle; the file, of at most MOST_BYTES, is left at its end. Damage raises any Exception."""
        self._stack, self._marked, self._memo = [], [], {}
        for operation, argument, _ in pickletools.genops(file):
            self._spend(1)
            if operation.name == "STOP":
                break
            self._carry_out(operation.name, argument)
        (result,) = self._stack
        self._check(result)
        return result

    def _spend(self, operations: int) -> None:
        self._left -= operations
        if self._left < 0:
            raise ValueError("too long")

    def _carry_out(self, name: str, argument: Any) -> None:
        """Carry out one operation of a pickle, by its name in `pickletools`, on the stack."""
        stack = self._stack
        match name:
            case "PROTO":
                pass
            case "NONE":
                stack.append(None)
            case "NEWTRUE" | "NEWFALSE":
                stack.append(name == "NEWTRUE")
            case "BININT" | "BININT1" | "BININT2" | "LONG1" | "BINFLOAT" | "BINUNICODE" | "SHORT_BINSTRING":
                stack.append(argument)
            case "EMPTY_TUPLE" | "EMPTY_LIST" | "EMPTY_DICT":
                stack.append({"EMPTY_TUPLE": tuple, "EMPTY_LIST": list, "EMPTY_DICT": dict}[name]())
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                stack.append(tuple([stack.pop() for _ in range(int(name[-1]))][::-1]))
            case "BINPUT" | "LONG_BINPUT":
                self._memo[argument] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(self._memo[argument])
            case "GLOBAL":
                stack.append(self._names[argument])
            case "BINPERSID":
                stack.append(self._persistent(stack.pop()))
            case "MARK":
                self._marked.append(stack)
                self._stack = []
            case "TUPLE" | "APPENDS" | "SETITEMS":
                self._stack = self._marked.pop()
                self._gather(name, stack)
            case "APPEND" | "SETITEM":
                count = 1 if name == "APPEND" else 2
                self._gather(name + "S", [stack.pop() for _ in range(count)][::-1])
            case "REDUCE" | "NEWOBJ":
                arguments, function = stack.pop(), stack.pop()
                stack.append(self._call(function, arguments))
            case "BUILD":
                state = stack.pop()
                self._build(stack[-1], state)
            case _:
                raise ValueError("an operation that torch does not write")

    def _gather(self, name: str, items: list) -> None:
        """Gather items into a new tuple, or into the list or dict on top of the stack. name: the operation, in the
        plural."""
        if name == "TUPLE":
            self._stack.append(tuple(items))
            return
        target = self._stack[-1]
        if type(target) is not (list if name == "APPENDS" else dict):
            raise TypeError("items for something else than a list or a dict")
        if name == "APPENDS":
            target.extend(items)
        else:
            target |= plain_dict(zip(items[::2], items[1::2], strict=True))

    def _call(self, function: Any, arguments: Any) -> Any:
        """Call a function of `names` with a tuple of arguments, whose lengths count as operations."""
        if type(function) is not FunctionType or type(arguments) is not tuple:
            raise TypeError("a call of no function")
        # Otherwise a short program could have a long text or list copied at each of its operations.
        self._spend(sum(len(argument) for argument in arguments if type(argument) in (str, list, tuple, dict)))
        return function(*arguments)

    def _check(self, result: Any) -> None:
        """ValueError for a result that is too large or too deep, as one is that contains itself."""
        left, count = [(result, 0)], 1
        while left:
            part, depth = left.pop()
            if type(part) not in (dict, list, tuple):
                if type(part) not in self._leaves:
                    raise TypeError("an object that belongs into no result")
                continue
            count += len(part)
            if count > _MOST_VALUES or depth == _DEEPEST:
                raise ValueError("too large or too deep")
            left += [(value, depth + 1) for value in (part.values() if type(part) is dict else part)]


def plain_dict(pairs: Any) -> dict[str | int, Any]:
    """Make a dict of (key, value) pairs. TypeError for keys other than text and indices: these may hash slowly."""
    result = {}
    for key, value in pairs:
        if type(key) is not str and not (type(key) is int and 0 <= key < 2**63):
            raise TypeError("a key that is neither a text nor an index")
        result[key] = value
    return result
