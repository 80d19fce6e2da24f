"""Licences for published data, by their SPDX names. A command's help reads this file: it imports
nothing heavy."""

from dataclasses import dataclass

from scenegen.errors import PublishError


@dataclass(frozen=True)
class Licence:
    """A licence for data, named rather than copied."""

    spdx: str
    name: str
    url: str

    @property
    def hub(self) -> str:
        """Its name on the Hub."""
        named = {"ODC-By-1.0": "odc-by", "PDDL-1.0": "pddl", "ODbL-1.0": "odbl"}
        return named.get(self.spdx, self.spdx.lower())

    def text(self, holder: str) -> str:
        """The LICENSE file of data that `holder` publishes."""
        return (
            f"This dataset, published by {holder}, is licensed under\n\n"
            f"    {self.name}\n    SPDX-License-Identifier: {self.spdx}\n    {self.url}\n\n"
            "The full text at this address is what counts. The files are provided as they are, "
            "without any warranty.\n"
        )


def _creative_commons(short: str, name: str) -> Licence:
    url = f"https://creativecommons.org/licenses/{short.lower()}/4.0/"
    return Licence(f"CC-{short}-4.0", f"Creative Commons {name} 4.0 International", url)


_ZERO = "https://creativecommons.org/publicdomain/zero/1.0/"
_OPEN = "https://opendatacommons.org/licenses"
LICENCES = (
    _creative_commons("BY", "Attribution"),
    _creative_commons("BY-SA", "Attribution-ShareAlike"),
    _creative_commons("BY-NC", "Attribution-NonCommercial"),
    Licence("CC0-1.0", "Creative Commons Zero 1.0 Universal", _ZERO),
    Licence("ODC-By-1.0", "Open Data Commons Attribution 1.0", f"{_OPEN}/by/1-0/"),
    Licence("ODbL-1.0", "Open Data Commons Open Database 1.0", f"{_OPEN}/odbl/1-0/"),
    Licence("PDDL-1.0", "Open Data Commons Public Domain 1.0", f"{_OPEN}/pddl/1-0/"),
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
