"""Settings of all tests."""

import pytest
import torch
from hypothesis import settings

# The same examples in every run: a suite that fails once in a while says nothing about a change.
settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")


@pytest.fixture
def one_thread():
    """Compute with one thread, and give the threads back."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
