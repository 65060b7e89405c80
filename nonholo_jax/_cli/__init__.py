"""The command line: its verbs, their reports, and the clock, which starts when the package begins to be imported."""

from . import clock as clock
