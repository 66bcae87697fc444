"""`start.prepare()` on import. A command imports this first, and only where it is the program itself."""

from utils.host.start import prepare

prepare()
