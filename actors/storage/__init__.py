"""Files: local or remote locations, zarr columns, durable writes."""
