"""Record the pinned verdicts anew."""

from dexkit.conformance.mutants.matrix import Score, chosen
from tests.pinned import BLAMED, SAMPLE_VERDICTS, blamed_sets, sample_verdicts, save

if __name__ == "__main__":
    save(SAMPLE_VERDICTS, sample_verdicts())
    requirements, trials = chosen()
    score = Score(requirements)
    for outcome in score.run(trials):
        print(f"{len(score.outcomes)} of {len(trials)}: {outcome.name}", flush=True)
    save(BLAMED, blamed_sets(score.outcomes))
