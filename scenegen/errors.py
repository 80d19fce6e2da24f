"""What can be wrong with what a user gave. Every message is one line: what, where, what was expected, how to fix it."""


class ScenegenError(Exception):
    """Base of every error that a user can act on; the command line prints it without a traceback."""


class RecipeError(ScenegenError):
    """A recipe names an unknown parameter, or one that no world can have."""


class SceneError(ScenegenError):
    """An MJCF document cannot serve as a world."""


class GenerationError(ScenegenError):
    """No acceptable world came out of the allowed number of draws."""


class DatasetError(ScenegenError):
    """A folder does not hold the dataset that it should, or cannot take it."""


class PublishError(ScenegenError):
    """A dataset cannot be published as asked, or not to that place."""


class StoppedError(ScenegenError):
    """The run was stopped from outside; what is finished stays."""
