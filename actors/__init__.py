"""What runs many times: policy, exploration, rollout worker, replay shard, evaluator."""
