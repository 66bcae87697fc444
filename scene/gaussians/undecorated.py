"""Methods of torch's optimisers without the decorator whose first call imports torch's compiler."""

import sys
from collections.abc import Callable
from types import FunctionType


def undecorated(method: Callable) -> Callable:
    """The method that torch hides from its compiler, unless that is loaded.

    torch._disable_dynamo imports torch._dynamo, in one to five seconds, to tell it to leave the method alone. While
    nobody has loaded the compiler, there is nobody to tell.
    """
    hidden = isinstance(method, FunctionType) and method.__globals__.get("__name__") == "torch._compile"
    return method.__wrapped__ if hidden and "torch._dynamo" not in sys.modules else method
