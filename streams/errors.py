"""The one family of errors that mapstream raises; each names a thing, what was found, what to try."""


class MappingError(Exception):
    """Anything that a user of mapstream can act on."""


class ConfigError(MappingError):
    """A graph file or an option; the message starts with the file and line, or the key's path."""


class ChannelError(MappingError):
    """A message that a channel may not take: sent after the end, or behind the time bound."""


class TransformError(MappingError):
    """A transform that nobody gave; the message has the frames, the stamp, and what is known."""


class RecordingError(MappingError):
    """A recording that cannot be read or written; the message has the file, the topic, the offset."""


class DecodeError(RecordingError):
    """One message that cannot be decoded; the message has the schema and the reason."""


class MapError(MappingError):
    """A map that cannot be used."""


class MapFormatError(MapError):
    """A map folder of another version, or none at all; the message says what to do."""


class MapCheckError(MapError):
    """A map that breaks its own rules; the message lists the violations."""


class EstimationError(MappingError):
    """A problem that could not be solved; the message names the variables."""


class OperatorError(MappingError):
    """An operator that failed; the message names it, the cause is chained."""
