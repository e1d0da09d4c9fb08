"""What a run leaves behind: the map, its tables, its files and its rules."""

from mapstream.recordings.maps.model import Map

__all__ = ["Map"]
