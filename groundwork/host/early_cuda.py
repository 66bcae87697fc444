"""`start.begin_cuda()` on import. A command that computes on a GPU imports this, and only where it is the program."""

from groundwork.host.start import begin_cuda

begin_cuda()
