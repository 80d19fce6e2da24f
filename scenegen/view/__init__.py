"""What was made, to look at.

`look` reads of a sample what can be shown. A page for a browser is made by `page` and served by
`live`, and shown in notebooks by `notebook`; pictures by matplotlib are made by `pictures` and
`figures`, of the parts in `panels`; `inspect` sums datasets up. `exchange` writes other programs'
formats.
"""
