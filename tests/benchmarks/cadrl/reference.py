"""What TensorFlow's own session gives for the published graph: `python -m tests.benchmarks.cadrl.reference FOLDER`.

FOLDER holds the package `gym_collision_avoidance`; the interpreter needs TensorFlow. It prints JSON, kept as
`reference.json`, against which `make league` holds the network in numpy.
"""

import json
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.cadrl.network import CHECKPOINT, INPUTS, MOST_OTHERS, PACKAGE, action_logits, published_weights

FILE = Path(__file__).with_name("reference.json")
TOLERANCE = 1e-5


def observations() -> NDArray[np.float32]:
    """Observations `[40, 138]` of two for each number of other robots, drawn from a stream of their own."""
    rng = np.random.default_rng(0)
    count = np.repeat(np.arange(MOST_OTHERS + 1), 2)
    drawn = rng.uniform(-2, 4, (len(count), INPUTS)).astype(np.float32)
    drawn[:, 0] = count
    return drawn


def largest_difference() -> float:
    """Largest difference of an action's probability from what TensorFlow gave."""
    logits = action_logits(observations(), published_weights())
    odds = np.exp(logits - logits.max(axis=1, keepdims=True))
    expected = np.array(json.loads(FILE.read_text("utf-8")))
    return float(np.abs(odds / odds.sum(axis=1, keepdims=True) - expected).max())


def main() -> int:
    import tensorflow.compat.v1 as tf  # only here: whoever measures has none

    prefix = str(Path(sys.argv[1]) / PACKAGE / CHECKPOINT)
    with tf.Graph().as_default(), tf.Session() as session:
        tf.train.import_meta_graph(f"{prefix}.meta", clear_devices=True).restore(session, prefix)
        found = session.run("Softmax:0", {"X:0": observations()})
    print(json.dumps([[round(float(value), 7) for value in row] for row in found]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
