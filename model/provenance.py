"""Where a network comes from: the versions that made it."""

import platform

from scenegen.dataset.manifest import installed, software

PACKAGES = ("torch", "safetensors")


def versions() -> dict[str, str]:
    """Versions of what a trained network depends on."""
    return software() | {"python": platform.python_version()} | {name: installed(name) for name in PACKAGES}
