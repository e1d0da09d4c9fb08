"""What a run leaves behind: the map, its tables, its files and its rules."""

from mapstream.recordings.maps.check import Violation, check_map, require_valid
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.store import load_map, save_map

__all__ = ["Map", "Violation", "check_map", "load_map", "require_valid", "save_map"]
