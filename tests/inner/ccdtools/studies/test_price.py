"""A redesign's price has a unit, and is not negative."""

import pytest

from ccdtools import InputError
from ccdtools.studies.options import Options
from ccdtools.studies.price import RedesignPrice, accepted_loss


@pytest.mark.parametrize(
    ("text", "needed"), [("0.5 %", 1.0), ("2%", 4.0), (" 0 % ", 0.0), ("12 return", 6.0), ("1e-1 return", 0.05)]
)
def test_a_price_is_a_part_of_the_return_or_in_its_units(text, needed):
    assert RedesignPrice.parse(text).needed(size=200.0, part=0.5) == pytest.approx(needed)


@pytest.mark.parametrize(
    "text", ["0.5", 0.5, "-1 %", "-0 %", "nan %", "inf return", "1e999 %", "5 kg", "% 5", "", None, ["1 %"], True]
)
def test_a_price_without_a_unit_or_below_zero_is_refused_with_the_cure(text):
    with pytest.raises(InputError, match=r"redesign_price: got .*expected a price ≥ 0 with its unit.*Write \"0.5 %\""):
        RedesignPrice.parse(text)


def test_the_option_is_refused_by_its_own_name():
    with pytest.raises(InputError, match="--redesign-price: got '12'"):
        Options("illustrative", redesign_price="12")
    assert Options("illustrative", redesign_price="12 return").redesign_price == "12 return"


@pytest.mark.parametrize("text", ["-1 %", "1", "12 return", "101 %", "half", 0.5, None, "nan %"])
def test_an_accepted_loss_that_is_no_part_of_a_return_is_refused(text):
    with pytest.raises(InputError, match=r"accept_loss: got .*expected a loss from 0 % to 100 %.*Write \"1 %\""):
        accepted_loss(text)
    if isinstance(text, str):
        with pytest.raises(InputError, match="--accept-loss: got"):
            Options("illustrative", accept_loss=text)


def test_a_loss_is_accepted_in_per_cent_of_the_return():
    assert accepted_loss("1 %") == 0.01
    assert accepted_loss("0 %") == 0
    assert Options("illustrative", accept_loss="2 %").accept_loss == "2 %"
