"""Results pooled over training seeds, and the claims judged on them."""
