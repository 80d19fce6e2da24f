"""A dataset for others: `regenerate` says what makes it again, `card` describes it, `stage` puts
the folder together, `upload` sends it.

Here are the licences for data by their SPDX names. A command's help reads them: nothing heavy is
imported.
"""

_CREATIVE, _OPEN = "https://creativecommons.org", "https://opendatacommons.org/licenses"
LICENCES = {
    "CC-BY-4.0": (
        "Creative Commons Attribution 4.0 International",
        f"{_CREATIVE}/licenses/by/4.0/",
    ),
    "CC-BY-SA-4.0": (
        "Creative Commons Attribution-ShareAlike 4.0 International",
        f"{_CREATIVE}/licenses/by-sa/4.0/",
    ),
    "CC-BY-NC-4.0": (
        "Creative Commons Attribution-NonCommercial 4.0 International",
        f"{_CREATIVE}/licenses/by-nc/4.0/",
    ),
    "CC0-1.0": ("Creative Commons Zero 1.0 Universal", f"{_CREATIVE}/publicdomain/zero/1.0/"),
    "ODC-By-1.0": ("Open Data Commons Attribution 1.0", f"{_OPEN}/by/1-0/"),
    "ODbL-1.0": ("Open Data Commons Open Database 1.0", f"{_OPEN}/odbl/1-0/"),
    "PDDL-1.0": ("Open Data Commons Public Domain 1.0", f"{_OPEN}/pddl/1-0/"),
}
"""Name and address of each."""
USUAL = "CC-BY-4.0"
"""What data get where nothing else is asked for."""
