"""`start.prepare()` on import. A command imports this first, and only where it is the program itself."""

from splatting.host.start import prepare

prepare()
