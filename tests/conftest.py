"""What all tests share: a process that any of them may start Ray in, and a real S3 server (moto's)."""

import os
from collections.abc import Iterator

import pytest

from learner.ray_backend.auth import guard_ray

guard_ray(joins=False)  # as `shoal` does: Ray reads this once, when the first test module imports it

BUCKET = "shoal-tests"


@pytest.fixture(scope="session")
def s3_server() -> Iterator[str]:
    """URL of an empty bucket on a server of this machine, for this process and those that it starts."""
    from moto.server import ThreadedMotoServer  # a second that other tests need not wait

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    values = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_MAX_ATTEMPTS": "1",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in values.items():
            patch.setenv(name, value)
        import s3fs

        s3fs.S3FileSystem().mkdir(f"s3://{BUCKET}")
        yield f"s3://{BUCKET}"
        s3fs.S3FileSystem.clear_instance_cache()
    server.stop()
    assert os.environ.get("AWS_ENDPOINT_URL") != values["AWS_ENDPOINT_URL"]
