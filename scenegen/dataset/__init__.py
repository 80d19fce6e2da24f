"""Datasets on disk: planned, written shard by shard, resumed, and read. docs/format.md is the
contract."""
