"""Shows samples, worlds and datasets.

`look` reads a sample for all the others, and `opened` scans, logs, maps and worlds. `page` makes a
page for a browser, and serves it; `live` serves a running simulation; `notebook` shows a page in
notebooks. `stills` draws by matplotlib, with voxels by `blocks` and colours of `canvas`. `glb`
writes a world for other viewers, and `inspect` summarizes datasets.
"""
