"""Remote stores: buckets of S3's protocol by boto3, and any other scheme, for reading, by
fsspec."""

import base64
import hashlib
import os
import re
import time
from collections.abc import Callable, Iterator
from typing import IO, Any, NoReturn, TypeVar

from scenegen.errors import DatasetError, StoreError, needs, printable
from scenegen.stores import ConflictError, Object, Store, Version

Result = TypeVar("Result")

NAME = re.compile(
    r"s3://(?P<bucket>[a-z0-9][a-z0-9.-]{1,61}[a-z0-9])(/(?P<prefix>.*[^/]))?/?", re.ASCII
)
ATTEMPTS = 11
"""How often a request is sent whose answer is lost or says that the server has trouble: for about
half a minute."""
CUTS = 4
"""How often an object is asked for whose answer is cut off."""
CONNECT_S, READ_S = 5, 60
"""Seconds after which a silent server counts as one that does not answer."""
PIECE_BYTES = 1 << 20
LOST = ("ConditionalRequestConflict", "PreconditionFailed")
FULL = (
    "QuotaExceeded",
    "XMinioStorageFull",
    "InsufficientCapacity",
    "StorageLimitExceeded",
    "NotEnoughSpace",
)
SETTINGS = (
    "ValueError",
    "InvalidRegionError",
    "ConfigParseError",
    "ConfigNotFound",
    "InvalidConfigError",
)
"""Errors of boto3 before it asks anybody."""
EXPIRED = (
    "ExpiredToken",
    "InvalidToken",
    "TokenRefreshRequired",
    "ExpiredTokenException",
    "RequestExpired",
)


class Bucket(Store):
    """See `Store`. ``s3://bucket/prefix``; the bucket is there already."""

    def __init__(self, name: str):
        match = NAME.fullmatch(name)
        if match is None:
            raise DatasetError(
                f"{printable(name)[:200]}: expected s3://BUCKET/FOLDER, "
                "where BUCKET has 3 to 63 lower-case letters, digits, dots or hyphens"
            )
        self.name = name.rstrip("/")
        self.bucket, self.prefix = match["bucket"], f"{match['prefix']}/" if match["prefix"] else ""
        try:
            import boto3
            import botocore.exceptions
            from botocore.config import Config
        except ImportError:
            raise DatasetError(f"{self.name}: {needs('boto3', 's3')}") from None
        self._errors = botocore.exceptions
        own = any(os.environ.get(name) for name in ("AWS_ENDPOINT_URL", "AWS_ENDPOINT_URL_S3"))
        config = Config(
            retries={"mode": "standard", "max_attempts": ATTEMPTS},
            connect_timeout=CONNECT_S,
            read_timeout=READ_S,
            # servers of earlier years know no others than MD5
            request_checksum_calculation="when_required",
            response_checksum_validation="when_required",
            **({"s3": {"addressing_style": "path"}} if own else {}),
        )
        self._client: Any = self._ask(
            "", lambda: boto3.session.Session().client("s3", config=config)
        )
        self._bare = False
        """Whether the server compares versions without their quotation marks, as Ceph's of 2021
        does."""

    def list(self) -> Iterator[Object]:
        """See `Store`."""
        after: dict[str, str] = {}
        while True:
            asked = {"Bucket": self.bucket, "Prefix": self.prefix, "Delimiter": "/", **after}
            found = self._ask("", self._client.list_objects_v2, "IsTruncated", **asked)
            try:
                for item in found.get("Contents", ()):
                    yield Object(item["Key"].removeprefix(self.prefix), item["Size"], item["ETag"])
                if not found["IsTruncated"]:
                    return
                after = {"ContinuationToken": found["NextContinuationToken"]}
            except KeyError as error:
                raise self._silent("", f"its list lacks {error.args[0]}") from None

    def read(self, name: str, file: IO[bytes], most_bytes: int) -> Version:
        """See `Store`."""
        for attempt in range(CUTS):
            found = self._ask(
                name, self._client.get_object, "ETag", "ContentLength", **self._object(name)
            )
            with found["Body"] as body:
                if found["ContentLength"] > most_bytes:
                    raise DatasetError(
                        f"{self.name}/{name}: {found['ContentLength']} bytes, expected "
                        f"{most_bytes} at most"
                    )
                try:
                    while piece := body.read(PIECE_BYTES):
                        file.write(piece)
                    if file.tell() == found["ContentLength"]:
                        return found["ETag"]
                except (self._errors.BotoCoreError, self._errors.HTTPClientError):
                    pass
            file.seek(0)  # cut off on the way, which not every version of the HTTP client minds
            file.truncate()
            time.sleep(min(2**attempt / 10, 10.0))
        raise self._silent(name, "its answers end too early")

    def put_whole(self, name: str, content: bytes) -> Version:
        """See `Store`."""
        return self._put(name, content)

    def put_if(self, name: str, content: bytes, version: Version) -> Version:
        """See `Store`."""
        if version is None:
            return self._put(name, content, IfNoneMatch="*")
        try:
            return self._put(name, content, IfMatch=version.strip('"') if self._bare else version)
        except ConflictError:
            if self._bare or self._version(name) != version:
                raise
        self._bare = True  # the version is as it was, so it is the quotation marks
        return self.put_if(name, content, version)

    def remove(self, name: str) -> None:
        """See `Store`."""
        self._ask(name, self._client.delete_object, **self._object(name))

    def _put(self, name: str, content: bytes, **condition: str) -> Version:
        # its own checksum goes with it: a server takes what arrives as it was sent, or refuses it
        checksum = base64.b64encode(hashlib.md5(content, usedforsecurity=False).digest()).decode()
        sent = {"Body": content, "ContentMD5": checksum, **condition}
        return self._ask(name, self._client.put_object, "ETag", **self._object(name), **sent)[
            "ETag"
        ]

    def _object(self, name: str) -> dict[str, str]:
        return {"Bucket": self.bucket, "Key": self.prefix + name}

    def _version(self, name: str) -> Version:
        try:
            return self._ask(name, self._client.head_object, "ETag", **self._object(name))["ETag"]
        except FileNotFoundError:
            return None

    def _ask(
        self, name: str, method: Callable[..., Result], *needed: str, **options: Any
    ) -> Result:
        """What the server answers, which holds what is `needed`. Nothing of what it says is
        repeated but its code: a server may repeat what it was sent, and that holds a signature."""
        errors, where = self._errors, f"{self.name}/{name}" if name else self.name
        try:
            answer = method(**options)
            if lacks := [key for key in needed if key not in answer]:  # type: ignore[operator]
                raise self._silent(name, f"its answer lacks {lacks[0]}")
            return answer
        except RecursionError:
            raise self._silent(name, "it redirects in a circle") from None
        except errors.ClientError as error:
            code = re.sub(
                r"[^A-Za-z0-9]", "", str(error.response.get("Error", {}).get("Code", ""))
            )[:60]
            status = error.response.get("ResponseMetadata", {}).get("HTTPStatusCode", 0)
        except (errors.BotoCoreError, errors.HTTPClientError, OSError, ValueError) as error:
            kind = type(error).__name__
            if re.search("Credential|Token|Profile|SSO|Login", kind):
                raise StoreError(f"{where}: no credentials are found ({kind}); {GIVE}") from None
            if kind in SETTINGS:
                raise StoreError(
                    f"{where}: a setting of AWS cannot be used ({kind}); see to AWS_ENDPOINT_URL, "
                    f"AWS_DEFAULT_REGION "
                    "and the file of AWS_CONFIG_FILE"
                ) from None
            raise self._silent(name, kind) from None
        if code in LOST or status in (409, 412):
            raise ConflictError(f"{where}: somebody else has put it")
        if code == "NoSuchBucket":
            raise StoreError(
                f"{where}: there is no bucket {self.bucket}; make it, or name one that is there"
            )
        if status == 404 and not name:
            raise StoreError(
                f"{where}: nothing is there that speaks S3's protocol; see to AWS_ENDPOINT_URL"
            )
        if status == 404:
            raise FileNotFoundError(where)
        if code in FULL or status == 507:
            raise StoreError(
                f"{where}: the store is full ({code}); free some space, or raise its quota; {AGAIN}"
            )
        if code in EXPIRED or status in (401, 403):
            raise StoreError(
                f"{where}: the store refuses the credentials ({code}); renew them, or what they "
                f"allow; {AGAIN}"
            )
        raise self._silent(name, f"{status} {code}")

    def _silent(self, name: str, said: str) -> StoreError:
        where = f"{self.name}/{name}" if name else self.name
        return StoreError(
            f"{where}: the store does not answer ({said}); see to the network and the server; "
            f"{AGAIN}"
        )


AGAIN = "what is finished is kept: give the same command again to go on"
GIVE = "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or log in by Amazon's tools"


class Foreign(Store):
    """See `Store`."""

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
        """See `Store`."""
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
        """See `Store`."""
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
        """Raises StoreError."""
        self._read_only()

    def put_if(self, name: str, content: bytes, version: Version) -> Version:
        """Raises StoreError."""
        self._read_only()

    def remove(self, name: str) -> None:
        """Raises StoreError."""
        self._read_only()

    def _read_only(self) -> NoReturn:
        raise StoreError(
            f"{self.name}: is for reading alone; write to a folder, or to s3://bucket/folder"
        )

    def _refused(self, name: str, error: Exception) -> StoreError:
        """Without what the file system says, which may hold anything."""
        where = f"{self.name}/{name}" if name else self.name
        return StoreError(
            f"{where}: cannot be read ({type(error).__name__}); see to the name, the network and "
            f"the rights"
        )
