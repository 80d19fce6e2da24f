"""Draw the study of a bench's report, or all of `scenegen reproduce`, again.

python docs/figures.py bench/report.json [docs/pictures]     needs the extra `train`; writes the
pictures' *.png python docs/figures.py study/study.json docs/pictures
"""

import json
import sys
from pathlib import Path

from scenegen.model.evaluation.study.figures import draw
from scenegen.model.reproduce.report import draw as draw_all

if __name__ == "__main__":
    source = Path(sys.argv[1])
    folder = Path(sys.argv[2]) if len(sys.argv) > 2 else source.parent
    held = json.loads(source.read_text())
    for name, picture in (draw_all if "verdicts" in held else draw)(held).items():
        (folder / name).write_bytes(picture)
        print(folder / name)
