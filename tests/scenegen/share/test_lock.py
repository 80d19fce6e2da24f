"""The lock pins what is needed and nothing else, as the dataset's makers had it."""

import importlib.metadata

from scenegen.share.publication import closure, environment_lock


def test_it_pins_what_scenegen_needs_and_no_extras() -> None:
    found = closure("scenegen-lidar")
    for name in ("numpy", "mujoco", "h5py", "llvmlite"):
        assert found[name] == importlib.metadata.version(name)
    assert not {"pytest", "pyvista", "scenegen", "huggingface-hub"} & set(found)


def test_versions_that_made_the_dataset_win() -> None:
    lines = environment_lock(
        {"numpy": "2.0.1", "scenegen": "0.0.9", "machine": "x86_64"}, "abc123"
    ).splitlines()
    assert "numpy==2.0.1" in lines
    assert (
        lines[0]
        == f"# scenegen 0.0.9, published with {importlib.metadata.version('scenegen-lidar')}, "
        f"commit abc123"
    )
    assert not [line for line in lines[2:] if line.startswith(("scenegen", "machine", "#"))]
