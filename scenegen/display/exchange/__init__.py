"""Datasets in other programs' formats, one a file: a format says which files a sample becomes, and
what is in them.

A format with a number `together` puts so many samples into one file; its `encode` takes a list of
numbers and samples.
"""

from lidarsim.registry import Registry

FORMATS = Registry(
    "format",
    {
        "semantickitti": "scenegen.display.exchange.semantickitti:SemanticKitti",
        "npz": "scenegen.display.exchange.clouds:Npz",
        "ply": "scenegen.display.exchange.clouds:Ply",
        "pcd": "scenegen.display.exchange.clouds:Pcd",
        "octomap": "scenegen.display.exchange.octomap:OctoMap",
        "webdataset": "scenegen.display.exchange.webdataset:WebDataset",
        "mcap": "scenegen.display.exchange.mcap:Mcap",
        "rerun": "scenegen.display.exchange.rerun:Rerun",
    },
    needs={
        "names": "a method: (split, number) -> the files of a sample",
        "encode": "a method: (sample, grid, lidar) -> their contents, in order",
    },
)
"""Formats by name: classes made with the `Choices`."""
