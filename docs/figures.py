"""Draw the study of a bench's report again.

python docs/figures.py bench/report.json [docs/pictures]     needs the extra `train`; writes the pictures' *.png
"""

import json
import sys
from pathlib import Path

from scenegen.model.evaluation.study.figures import draw

if __name__ == "__main__":
    source = Path(sys.argv[1])
    folder = Path(sys.argv[2]) if len(sys.argv) > 2 else source.parent
    for name, picture in draw(json.loads(source.read_text())).items():
        (folder / name).write_bytes(picture)
        print(folder / name)
