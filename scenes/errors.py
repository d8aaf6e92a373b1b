"""The root of the errors that ``scenes`` raises."""


class SceneError(Exception):
    """A scene that cannot be built, rendered or written; the message names the value and the remedy."""
