"""Scenario files with configuration errors, and the expected parts of each error message.

The blocks of `bad_scenarios.txt` have the lines of a scenario file, then after > the expected text about key and value,
and the expected text about the allowed values. A line with # is a comment.
"""

import re
from pathlib import Path

SAMPLED = 'loop.mode = "sampled"\n'
ONE_KEY = "exactly one of quat_xyzw, quat_wxyz, rotvec_deg, mrp, dcm_body_to_inertial, euler_deg"
INERTIA = "three principal moments or a symmetric 3x3"
CUSTOM = 'plant = { kind = "system", system = "%s" }'


def _read():
    """Yield (text, of_what, allowed) for each scenario of bad_scenarios.txt.

    of_what, allowed: expected parts of its error message, the key with its value and the allowed values.
    """
    blocks = Path(__file__).with_suffix(".txt").read_text(encoding="utf-8").split("\n\n")
    for block in blocks:
        *lines, of_what, allowed = (line for line in block.splitlines() if not line.startswith("# "))
        yield "\n".join(lines), of_what[2:], allowed[2:]


BAD = [
    *_read(),
    # values beyond a limit, and names that are no files
    (f"disturbance.amplitude = ['1 mN m', {10**400}, 0]", 'amplitude is ["1 mN m", a whole number of', "three numbers"),
    (f"tune.steps = {10**26}", "tune.steps is 100000000000000000000000000", "from 1 to 100000"),
    (f"controller.eta = {'[' * 300}{']' * 300}", "has tables or arrays in each other", "at most 8 levels"),
    (f"controller{'.a' * 300} = 1", "has tables or arrays in each other", "at most 8 levels"),
    (f"[{'a.' * 5000}a]", "has tables or arrays in each other", "at most 8 levels"),
    (f"controller.eta = 0x{'f' * 5000}", "a whole number of 20000 bits", "is no finite number"),
    (f"controller.eta = 1{'0' * 400}", "controller.eta is a whole number of 1329 bits", "is no finite number"),
    (f"spacecraft.inertia = [1{'0' * 400}, 12, 14]", "inertia is [a whole number of 1329 bits, 12", INERTIA),
    (f"controller.error = '{'x' * 100_000}'", 'controller.error is "xxx', "... (100002 characters), but must be"),
    (f"observer.gain = [{'1.0, ' * 10_000}]", "observer.gain is [1.0, 1.0", "three numbers greater than 0"),
    (f"controller.{'x' * 100_000} = 1", 'controller has the key "xxx', "which is not a known one"),
    (f"{'x' * 100_000} = 1", 'the scenario has the key "xxx', "which is not a known one"),
    (
        SAMPLED + f"filter = {{ kind = 'steady_state', bandwidth = 0.1 }}\nhardware.star_tracker_every = {10**26}",
        "hardware.star_tracker_every is 100000000000000000000000000",
        "at most the 800 control periods",
    ),
    (CUSTOM % ("a" * 5000 + ".py:arm"), 'plant.system is "', "it cannot be read: File name too long"),
    (CUSTOM % ("a" * 300 + ".py:arm"), 'plant.system is "', "it cannot be read: File name too long"),
    (CUSTOM % "a\\u0000b.py:arm", r'plant.system is "a\u0000b.py:arm"', "it names nothing; allowed is"),
    (CUSTOM % "a\\u001b[2K.py:arm", r'plant.system is "a\u001b[2K.py:arm"', "it names nothing; allowed is"),
    (CUSTOM % "a\\u0000b:arm", r'plant.system is "a\u0000b:arm"', "it names nothing; allowed is"),
    (CUSTOM % "arm.py:a b", "arm.py:a b", "it names nothing; allowed is"),
    (CUSTOM % "a..b:arm", 'plant.system is "a..b:arm"', "it names nothing; allowed is"),
    (CUSTOM % "/:arm", 'plant.system is "/:arm"', "it names nothing; allowed is"),
]

# words that must not occur in an error message for the author of a scenario file
JARGON = re.compile(r"\n|Traceback|Error|Errno|could not convert|array element|np\.|tuple|\bNone\b|float64")


def check_sentence(said, of_what, allowed):
    """Assert that an error message is one sentence that names the key, its value and the allowed values.

    said: the message. of_what: text with the key and its value. allowed: text with the allowed values.
    """
    assert of_what in said
    assert allowed in said
    assert not JARGON.search(said)
    assert len(said) < 400
