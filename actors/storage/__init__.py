"""Storage: local or remote locations, zarr columns, durable writes, and the heap of long-running processes."""
