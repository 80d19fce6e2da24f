"""A place of any other scheme, by fsspec (https://filesystem-spec.readthedocs.io): for reading
alone, experimental."""

from collections.abc import Iterator
from typing import IO, NoReturn

from scenegen.errors import DatasetError, PlaceError, needs, printable
from scenegen.stores import Object, Place, Version

PIECE_BYTES = 1 << 20


class Foreign(Place):
    """See `Place`."""

    def __init__(self, name: str):
        try:
            import fsspec
        except ImportError:
            raise DatasetError(f"{printable(name)}: {needs('fsspec', 's3')}") from None
        self.name = name.rstrip("/")
        try:
            self._system, self._path = fsspec.core.url_to_fs(self.name)
        except (ValueError, ImportError, OSError) as error:
            raise DatasetError(
                f"{printable(name)}: fsspec has nothing here that reads it "
                f"({type(error).__name__}); give a folder, "
                "hf://user/name or s3://bucket/folder"
            ) from None

    def list(self) -> Iterator[Object]:
        """See `Place`."""
        try:
            found = self._system.ls(self._path, detail=True)
        except FileNotFoundError:
            return
        except Exception as error:  # each file system has its own
            raise self._refused("", error) from None
        for item in found:
            if item["type"] == "file":
                yield Object(item["name"].rpartition("/")[2], int(item["size"] or 0), None)

    def read(self, name: str, file: IO[bytes], most_bytes: int) -> Version:
        """See `Place`."""
        done = 0
        try:
            with self._system.open(f"{self._path}/{name}", "rb") as there:
                while piece := there.read(PIECE_BYTES):
                    done += len(piece)
                    if done > most_bytes:
                        break
                    file.write(piece)
        except FileNotFoundError:
            raise
        except Exception as error:  # each file system has its own
            raise self._refused(name, error) from None
        if done > most_bytes:
            raise DatasetError(f"{self.name}/{name}: more than {most_bytes} bytes")
        return None

    def put_whole(self, name: str, content: bytes) -> Version:
        """Raises PlaceError."""
        self._read_only()

    def put_if(self, name: str, content: bytes, version: Version) -> Version:
        """Raises PlaceError."""
        self._read_only()

    def remove(self, name: str) -> None:
        """Raises PlaceError."""
        self._read_only()

    def _read_only(self) -> NoReturn:
        raise PlaceError(
            f"{self.name}: is for reading alone; write to a folder, or to s3://bucket/folder"
        )

    def _refused(self, name: str, error: Exception) -> PlaceError:
        """Without what the file system says, which may hold anything."""
        where = f"{self.name}/{name}" if name else self.name
        return PlaceError(
            f"{where}: cannot be read ({type(error).__name__}); see to the name, the network and "
            f"the rights"
        )
