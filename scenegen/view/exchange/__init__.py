"""Datasets in other programs' formats, one a file: a format says which files a sample becomes, and
what is in them.

A format with a number `together` puts so many samples into one file; its `encode` takes a list of
numbers and samples.
"""

from lidarsim.registry import Registry

FORMATS = Registry(
    "format",
    {
        "semantickitti": "scenegen.view.exchange.semantickitti:SemanticKitti",
        "npz": "scenegen.view.exchange.clouds:Npz",
        "ply": "scenegen.view.exchange.clouds:Ply",
        "pcd": "scenegen.view.exchange.clouds:Pcd",
        "octomap": "scenegen.view.exchange.octomap:OctoMap",
        "webdataset": "scenegen.view.exchange.webdataset:WebDataset",
        "mcap": "scenegen.view.exchange.mcap:Mcap",
        "rerun": "scenegen.view.exchange.rerun:Rerun",
    },
    needs={
        "names": "a method: (split, number) -> the files of a sample",
        "encode": "a method: (sample, grid, lidar) -> their contents, in order",
    },
)
"""Formats by name: classes made with the `Choices`."""
