"""Licences for published data, by their SPDX names."""

from dataclasses import dataclass

from scenegen.errors import PublishError


@dataclass(frozen=True)
class Licence:
    """A licence, named rather than copied."""

    spdx: str
    name: str
    url: str

    @property
    def hub(self) -> str:
        """Its name on the Hub."""
        return {"ODC-By-1.0": "odc-by", "PDDL-1.0": "pddl", "ODbL-1.0": "odbl"}.get(
            self.spdx, self.spdx.lower()
        )

    def text(self, holder: str) -> str:
        """The LICENSE file of data that `holder` publishes."""
        return (
            f"This dataset, published by {holder}, is licensed under\n\n"
            f"    {self.name}\n    SPDX-License-Identifier: {self.spdx}\n    {self.url}\n\n"
            "The full text at this address is what counts. The files are provided as they are, "
            "without any warranty.\n"
        )


_CREATIVE_COMMONS = "https://creativecommons.org/"
LICENCES = (
    Licence(
        "CC-BY-4.0",
        "Creative Commons Attribution 4.0 International",
        _CREATIVE_COMMONS + "licenses/by/4.0/",
    ),
    Licence(
        "CC-BY-SA-4.0",
        "Creative Commons Attribution-ShareAlike 4.0 International",
        _CREATIVE_COMMONS + "licenses/by-sa/4.0/",
    ),
    Licence(
        "CC-BY-NC-4.0",
        "Creative Commons Attribution-NonCommercial 4.0 International",
        _CREATIVE_COMMONS + "licenses/by-nc/4.0/",
    ),
    Licence(
        "CC0-1.0",
        "Creative Commons Zero 1.0 Universal",
        _CREATIVE_COMMONS + "publicdomain/zero/1.0/",
    ),
    Licence(
        "ODC-By-1.0",
        "Open Data Commons Attribution 1.0",
        "https://opendatacommons.org/licenses/by/1-0/",
    ),
    Licence(
        "ODbL-1.0",
        "Open Data Commons Open Database 1.0",
        "https://opendatacommons.org/licenses/odbl/1-0/",
    ),
    Licence(
        "PDDL-1.0",
        "Open Data Commons Public Domain 1.0",
        "https://opendatacommons.org/licenses/pddl/1-0/",
    ),
)
"""Licences that are made for data."""
USUAL = LICENCES[0].spdx
"""What data get where nothing else is asked for."""


def find_licence(spdx: str) -> Licence:
    """The licence of that SPDX name, in any case. Raises PublishError for one not known here."""
    for licence in LICENCES:
        if licence.spdx.lower() == spdx.lower():
            return licence
    raise PublishError(
        f"--licence {spdx}: expected one of {', '.join(licence.spdx for licence in LICENCES)}"
    )
