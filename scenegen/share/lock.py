"""The environment lock: exact versions of scenegen's dependencies, and of theirs."""

import platform
import re
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, requires, version

from scenegen import __version__

LOCK = "requirements.lock.txt"
_NAME = re.compile(r"[A-Za-z0-9][\w.-]*", re.ASCII)


def environment_lock(made_with: Mapping[str, str], commit: str = "unknown") -> str:
    """A requirements file of what scenegen needs, as installed here.

    Packages in `made_with`, the manifest's `software`, come in the version that made the dataset.
    scenegen itself stands in a comment, with the `commit` of its checkout: it is installed from its
    own source, and a line here would ask a package index for whatever bears its name there.
    """
    found = {
        name: made_with.get(name, number)
        for name, number in sorted(closure("scenegen-lidar").items())
    }
    made = made_with.get("scenegen", __version__)
    head = [
        f"# scenegen {made}, published with {__version__}, commit {commit}",
        f"# {platform.python_implementation()} {platform.python_version()}, {platform.system()} "
        f"{platform.machine()}",
    ]
    return "\n".join([*head, *(f"{name}=={number}" for name, number in found.items())]) + "\n"


def closure(package: str) -> dict[str, str]:
    """Name to version of every installed distribution that `package` needs, without extras, and
    without itself."""
    found: dict[str, str] = {}
    waiting = _needs(package)
    while waiting:
        name = waiting.pop()
        if name in found or name == package:
            continue
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # for another platform or Python
            continue
        waiting += _needs(name)
    return found


def _needs(package: str) -> list[str]:
    """Names of what a distribution requires, its extras left out."""
    names = []
    for requirement in requires(package) or []:
        wanted, _, marker = requirement.partition(";")
        match = _NAME.match(wanted)
        if match and "extra" not in marker:
            names.append(re.sub(r"[-_.]+", "-", match[0]).lower())
    return names
