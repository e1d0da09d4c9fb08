"""mapstream: sensor streams to maps, as a graph of typed operators."""

from importlib.metadata import version

__version__ = version("mapstream")
