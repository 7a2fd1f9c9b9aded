"""What all tests share."""

import signal

import torch
from hypothesis import settings

# As in all experiments. Threads that wait for each other by spinning starve what runs beside: tests, or other work.
torch.set_num_threads(1)

# How long an example takes depends on what else the machine does.
settings.register_profile("op3", deadline=None)
settings.load_profile("op3")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell without job control starts background jobs with Ctrl-C ignored, and their children inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
