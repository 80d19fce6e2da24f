"""Whether a case ended well."""

import fnmatch

SECONDS = 60.0
"""A case may take so long, by the clock; most take a tenth of a second, but others may be at
work."""
PROCESSOR_SECONDS = 20
"""Any of its processes may compute for so long."""
MEMORY_BYTES = 2 << 30
"""Address space that a case may take beyond the process it is forked from."""
RESIDENT_BYTES = 1 << 30
"""Memory that it may fill."""
MAX_CHARACTERS = 2000
"""In an error's line."""


def verdict(attempt, result):
    """What is wrong with how `attempt` ended: a sentence, or an empty one."""
    if result.failure:
        return f"the process {result.failure}"
    if result.left_running:
        return "left a process running"
    wrong = _said_well(attempt, result) or _left_well(attempt, result)
    if not wrong and result.grown_bytes > RESIDENT_BYTES:
        wrong = f"took {result.grown_bytes >> 20} MB"
    return wrong or ("" if result.code else attempt.holds(result))


def _said_well(attempt, result):
    """Errors say one line, successes say nothing on standard error, and neither talks to the
    terminal."""
    if not all(character.isprintable() or character == "\n" for character in result.stdout):
        return "printed control characters"
    if result.code == 0:
        return f"said on standard error: {result.stderr[:300]!r}" if result.stderr else ""
    if "Traceback" in result.stderr:
        return f"ended in a traceback: …{result.stderr[-800:]}"
    line = result.stderr.removesuffix("\n")
    if not line.startswith("scenegen: ") or not line.isprintable():
        return f"ended with {result.code} and not in one line: {result.stderr[:300]!r}"
    if len(line) > MAX_CHARACTERS:
        return f"ended in a line of {len(line)} characters: {line[:300]}…"
    if "out of memory" in line and not attempt.may_lack_memory:
        return "ran out of memory"
    return ""


def _left_well(attempt, result):
    """Nothing beside the command's own output was made, changed or removed."""
    strange = [
        name
        for name in result.changed
        if not any(fnmatch.fnmatch(name, made) for made in attempt.makes)
    ]
    if strange:
        return f"left or changed {', '.join(strange[:5])}"
    drafts = [name for name in result.changed if name.endswith(".tmp")]
    return f"left its draft {drafts[0]}" if drafts else ""
