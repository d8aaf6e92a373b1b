"""No test sees the parts that a user has added on this machine."""

import pytest

from cad.parts import PARTS_DIR_VARIABLE


@pytest.fixture(autouse=True, scope="session")
def no_parts_of_the_user(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(PARTS_DIR_VARIABLE, str(tmp_path_factory.mktemp("parts")))
        yield
