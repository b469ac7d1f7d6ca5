"""Wrong calls are refused in one line that names the argument."""

import pytest

from ccdtools import CCDError


def assert_refused(call, argument):
    """Call, and look at the error; `argument` is None where the error has none."""
    with pytest.raises(CCDError) as caught:
        call()
    text = str(caught.value)
    assert "\n" not in text, text
    assert len(text) < 400, text
    assert ".cpp:" not in text, text  # of CasADi's own source
    assert "--" not in text, text  # the API knows nothing of the options of the command line
    if argument is not None:
        assert caught.value.argument == argument, text
        assert text.startswith(f"{argument}: got "), text
        assert ", expected " in text, text
