"""A dataset's worlds, compiled again."""

from scenegen.dataset.extract import DOCUMENT
from scenegen.dataset.read import Dataset
from scenegen.errors import BrokenError, DatasetError, SceneError
from scenegen.worlds.screen import screen
from scenegen.worlds.world import World, compile_world


def compile_archived(dataset: Dataset, split: str, number: int) -> World:
    """World `number` of a split, compiled; the document is screened before MuJoCo sees it.

    Raises DatasetError where there is none, or it cannot be compiled.
    """
    files = dataset.world(split, number)
    document, name = files.pop(DOCUMENT), f"{number:06d}.xml"
    try:
        screen(document, files, name)
        return compile_world(document, files, name=name)
    except (BrokenError, SceneError) as error:
        raise DatasetError(
            f"{dataset.folder}: {error}; copy the dataset again, or generate it"
        ) from None
