"""Settings of all tests."""

from hypothesis import settings

# The same examples in every run: a suite that fails once in a while says nothing about a change.
settings.register_profile("repeatable", derandomize=True)
settings.load_profile("repeatable")
