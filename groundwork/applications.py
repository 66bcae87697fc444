"""Calls of applications by the core and by the commands at the root. An application's folder may be deleted."""

import sys
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

from groundwork.host.errors import UserError

VIEWER_PORT = 8080  # of view.py, and of train.py --viewer


def has_application(name: str) -> bool:
    """Tell if applications/NAME is there."""
    return find_spec("applications") is not None and find_spec(f"applications.{name}") is not None


def application(name: str, module: str) -> ModuleType:
    """Import applications/NAME/MODULE.py. UserError if that application was deleted."""
    if not has_application(name):
        raise UserError(f"this needs applications/{name}, which is not there; restore that folder of the repository")
    return import_module(f"applications.{name}.{module}")


def command(name: str) -> ModuleType:
    """Import the command of an application. Ends the program with status 2 if that application was deleted."""
    try:
        return application(name, "command")
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
