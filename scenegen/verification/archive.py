"""An archive of worlds is a zip of MJCF from anywhere: it is screened before MuJoCo sees it, and
stays in memory."""

from dataclasses import dataclass
from io import BufferedReader

import mujoco

from lidarsim import AnalyticEngine, Engine, MujocoEngine
from lidarsim.engines import MUJOCO
from lidarsim.solids.model import solids_of
from lidarsim.solids.shapes import Solids
from scenegen.dataset.archive import open_archive, referred
from scenegen.errors import SceneError, printable
from scenegen.verification.report import BrokenError
from scenegen.worlds.quiet import quiet_mujoco
from scenegen.worlds.screen import screen
from scenegen.worlds.world import World, compile_world


@dataclass(frozen=True, eq=False)
class Archive:
    """The worlds of one shard."""

    documents: dict[int, bytes]
    """MJCF by the world's number."""
    outlines: dict[int, bytes]
    """What `screen` gives for each document."""
    assets: dict[str, bytes]

    def world(self, number: int) -> tuple[bytes, dict[str, bytes]]:
        """Return a world's document and the files it refers to. Raises BrokenError where there is
        none."""
        if number not in self.documents:
            raise BrokenError(f"has no member {number:06d}.xml")
        document = self.documents[number]
        return document, {name: self.assets[name] for name in referred(document, self.assets)}


def read_archive(file: BufferedReader, name: str, most_worlds: int) -> Archive:
    """Read and screen all members of the archive in `file`. Raises BrokenError, which names `name`
    and the fault."""
    with open_archive(file, name) as members:
        if (worlds := sum(member.endswith(".xml") for member in members)) > most_worlds:
            raise BrokenError(f"{worlds} worlds, expected one a sample at most, {most_worlds}")
        contents = {member: members.read(member) for member in members}
        documents = {
            int(member[:-4]): content
            for member, content in contents.items()
            if member.endswith(".xml")
        }
        assets = {
            member: content for member, content in contents.items() if not member.endswith(".xml")
        }
        outlines = {
            number: screen(document, assets, f"{number:06d}.xml")
            for number, document in documents.items()
        }
    return Archive(documents, outlines, assets)


def compile_solids(document: bytes, assets: dict[str, bytes], name: str) -> Solids:
    """Compile an archived world that has been screened to its solids. Raises BrokenError, which
    names `name`."""
    try:
        with quiet_mujoco():
            return solids_of(mujoco.MjModel.from_xml_string(document.decode(), assets))
    except (ValueError, MemoryError, mujoco.FatalError) as error:
        raise BrokenError(f"{name}: MuJoCo cannot compile it: {printable(error)[:200]}") from None


def archived_world(archive: Archive, number: int) -> World:
    """World `number`, compiled from its archived document. Raises BrokenError."""
    try:
        return compile_world(*archive.world(number))
    except SceneError as error:
        raise BrokenError(str(error)) from None


def auditor(document: bytes, assets: dict[str, bytes], solids: Solids, *, made_with: str) -> Engine:
    """The engine that casts rays anew in a world whose `solids` have been compiled: never the one
    that the dataset was `made_with`, and always one of ours."""
    if made_with == MUJOCO:
        return AnalyticEngine(solids)
    with quiet_mujoco():
        return MujocoEngine.of(mujoco.MjModel.from_xml_string(document.decode(), assets))
