"""Shape checks are for the tests; what is timed goes without them."""

import jaxtyping
import pytest


@pytest.fixture(autouse=True)
def without_shape_checks():
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
