"""What the dashboard shows of a run or a sweep."""
