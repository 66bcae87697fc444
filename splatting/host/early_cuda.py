"""`cuda_start.begin()` on import. A command that computes on a GPU imports this, and only where it is the program."""

from splatting.host.cuda_start import begin

begin()
