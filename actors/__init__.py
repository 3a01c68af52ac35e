"""Components that run many times: rollout workers with their policy, replay shards, and the evaluator."""
