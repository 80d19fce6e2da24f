"""Remote stores: buckets of S3's protocol by boto3, and any other scheme, for reading, by
fsspec."""

import base64
import hashlib
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import IO, Any

from scenegen.errors import DatasetError, StoreError, needs, printable
from scenegen.stores import ANY, WHOLE, ConflictError, Object, Part, Store, Version

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
AGAIN = "what is finished is kept: give the same command again to go on"
FAULTS = {
    r"\d+ (ConditionalRequestConflict|PreconditionFailed)|(409|412) .*": "somebody else has put it",
    r"\d+ NoSuchBucket": "there is no such bucket; make it, or name one that is there",
    r"404 .*": "nothing is there that speaks S3's protocol; see to AWS_ENDPOINT_URL",
    r"\d+ (QuotaExceeded|XMinioStorageFull|InsufficientCapacity|StorageLimitExceeded)"
    r"|\d+ NotEnoughSpace|507 .*": "the store is full; free some space, or raise "
    f"its quota; {AGAIN}",
    r"\d+ (ExpiredToken(Exception)?|InvalidToken|TokenRefreshRequired|RequestExpired)"
    r"|(401|403) .*": f"the store refuses the credentials; renew them, or what they allow; {AGAIN}",
    r"[A-Za-z]*(Credential|Token|Profile|SSO|Login)[A-Za-z]*": "no credentials are found; set "
    "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or log in by Amazon's tools",
    "ValueError|InvalidRegionError|ConfigParseError|ConfigNotFound|InvalidConfigError": "a setting "
    "of AWS cannot be used; see to AWS_ENDPOINT_URL, AWS_DEFAULT_REGION and the file of "
    "AWS_CONFIG_FILE",
    ".*": f"the store does not answer; see to the network and the server; {AGAIN}",
}
"""What to say of an answer's status and code, or of an error of boto3 by its name; the first that
fits counts."""


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
            asked = {"Bucket": self.bucket, "Prefix": self.prefix, **after}
            found = self._ask("", self._client.list_objects_v2, "IsTruncated", **asked)
            try:
                for item in found.get("Contents", ()):
                    yield Object(item["Key"].removeprefix(self.prefix), item["Size"], item["ETag"])
                if not found["IsTruncated"]:
                    return
                after = {"ContinuationToken": found["NextContinuationToken"]}
            except KeyError as error:
                raise self._fault("", f"its list lacks {error.args[0]}") from None

    def read(self, name: str, file: IO[bytes], most_bytes: int, part: Part = WHOLE) -> Object:
        """See `Store`."""
        needed, asked = ["ETag", "ContentLength"], {}
        if part != WHOLE:  # a server that knows no parts sends the whole without saying so
            last = "" if part.stop is None else part.stop - 1
            needed.append("ContentRange")
            asked["Range"] = f"bytes={part.first}" + (f"-{last}" if part.first >= 0 else "")
        for attempt in range(CUTS):
            found = self._ask(name, self._client.get_object, *needed, **asked)
            size = found["ContentLength"]
            with found["Body"] as body:
                if size > most_bytes:
                    raise DatasetError(
                        f"{self.name}/{name}: {size} bytes, expected {most_bytes} at most"
                    )
                with suppress(self._errors.BotoCoreError, self._errors.HTTPClientError):
                    while piece := body.read(PIECE_BYTES):
                        file.write(piece)
                    if file.tell() == size:
                        whole = found.get("ContentRange", str(size)).rpartition("/")[2]
                        return Object(name, int(whole), found["ETag"])
            file.seek(0)  # cut off on the way, which not every version of the HTTP client minds
            file.truncate()
            time.sleep(2**attempt / 10)
        raise self._fault(name, "its answers end too early")

    def put(self, name: str, content: bytes, version: Version = ANY) -> Version:
        """See `Store`."""
        # its own checksum goes with it: a server takes what arrives as it was sent, or refuses it
        checksum = base64.b64encode(hashlib.md5(content, usedforsecurity=False).digest()).decode()
        sent = {"Body": content, "ContentMD5": checksum}
        if version is None:
            sent["IfNoneMatch"] = "*"
        elif version != ANY:
            sent["IfMatch"] = version.strip('"') if self._bare else version
        try:
            return self._ask(name, self._client.put_object, "ETag", **sent)["ETag"]
        except ConflictError:
            if "IfMatch" not in sent or self._bare or self._version(name) != version:
                raise
        self._bare = True  # the version is as it was, so it is the quotation marks
        return self.put(name, content, version)

    def remove(self, name: str) -> None:
        """See `Store`."""
        self._ask(name, self._client.delete_object)

    def _version(self, name: str) -> Version:
        try:
            return self._ask(name, self._client.head_object, "ETag")["ETag"]
        except FileNotFoundError:
            return None

    def _ask(self, name: str, method: Callable[..., Any], *needed: str, **options: Any) -> Any:
        """What the server answers about the object `name`, or, without, to other `options`; it
        holds what is `needed`."""
        if name:
            options |= {"Bucket": self.bucket, "Key": self.prefix + name}
        errors = self._errors
        try:
            answer = method(**options)
            if lacks := [key for key in needed if key not in answer]:
                raise self._fault(name, f"its answer lacks {lacks[0]}")
            return answer
        except errors.ClientError as error:
            code = re.sub(r"[^A-Za-z0-9]", "", str(error.response.get("Error", {}).get("Code")))
            status = error.response.get("ResponseMetadata", {}).get("HTTPStatusCode", 0)
            if name and status == 404 and code != "NoSuchBucket":
                raise FileNotFoundError(f"{self.name}/{name}") from None
            raise self._fault(name, f"{status} {code[:60]}") from None
        except (
            *(errors.BotoCoreError, errors.HTTPClientError),
            *(OSError, ValueError, RecursionError),  # the last for redirections in a circle
        ) as error:
            raise self._fault(name, type(error).__name__) from None

    def _fault(self, name: str, said: str) -> StoreError:
        """Nothing of what a server says is repeated but its code: it may repeat what it was sent,
        and that holds a signature."""
        fault = next(told for like, told in FAULTS.items() if re.fullmatch(like, said))
        kind = ConflictError if fault.startswith("somebody") else StoreError
        what, _, rest = fault.partition(";")
        return kind(f"{f'{self.name}/{name}'.rstrip('/')}: {what} ({said});{rest}".rstrip(";"))


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
                f"({type(error).__name__}); give a folder, hf://user/name or s3://bucket/folder"
            ) from None

    def list(self) -> Iterator[Object]:
        """See `Store`."""
        with suppress(FileNotFoundError):
            found = self._tried("", lambda: self._system.find(self._path, 2, detail=True))
            for name, item in found.items():
                there = name.removeprefix(self._path).lstrip("/")
                yield Object(there, int(item["size"] or 0), None)

    def read(self, name: str, file: IO[bytes], most_bytes: int, part: Part = WHOLE) -> Object:
        """See `Store`."""
        path = f"{self._path}/{name}"

        def read_part() -> Object:
            about = self._system.info(path)
            file.write(self._system.cat_file(path, *part))
            version = hashlib.sha256(repr(about).encode()).hexdigest()
            return Object(name, int(about["size"]), version)

        def read_whole() -> Object:
            file.seek(0)
            file.truncate()
            with self._system.open(path, "rb") as there:
                while piece := there.read(PIECE_BYTES):
                    file.write(piece)
                    if file.tell() > most_bytes:
                        raise DatasetError(f"{self.name}/{name}: more than {most_bytes} bytes")
            return Object(name, file.tell(), None)

        return self._tried(name, read_whole if part == WHOLE else read_part)

    def put(self, name: str, content: bytes, version: Version = ANY) -> Version:
        """Raises StoreError."""
        raise StoreError(
            f"{self.name}: is for reading alone; write to a folder, or to s3://bucket/folder"
        )

    def remove(self, name: str) -> None:
        """Raises StoreError."""
        self.put(name, b"")

    def _tried(self, name: str, ask: Callable[[], Any]) -> Any:
        """What `ask` returns, which is tried again where it fails. Raises errors without what the
        file system says, which may hold anything."""
        for attempt in range(CUTS):
            try:
                return ask()
            except (FileNotFoundError, DatasetError):
                raise
            except Exception as error:  # each file system has its own
                said = type(error).__name__
                time.sleep(2**attempt / 10)
        raise StoreError(
            f"{self.name}/{name}: cannot be read ({said}); see to the name, the network and the "
            "rights"
        )
