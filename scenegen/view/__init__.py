"""Shows samples, worlds and datasets.

`look` reads a sample for all the others. `page` makes a page for a browser, and serves it;
`notebook` shows it in notebooks. `pictures` and `figures` draw by matplotlib, with the parts in
`panels` and the colours in `canvas`. `glb` writes a world for other viewers, and `inspect`
summarizes datasets.
"""
