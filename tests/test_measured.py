"""What docs/measured.md says of our water beside measurements: that it is so, within its bounds."""

import numpy as np
import pytest

from experiments import measured_cases
from experiments import measured_data as data


def ratios(rows):
    return {row.what: row.ratio for row in rows}


@pytest.mark.slow
def test_a_rod_meets_what_a_rod_meets():
    found, before = (ratios(measured_cases.steady_drag(*x).rows) for x in ((), ("faces",)))
    assert found["square rod, face on"] == pytest.approx(1.75 / 2.0, rel=1e-6)
    assert found["square rod, edge on"] == pytest.approx(1.75 / 2**0.5 / 1.6, rel=1e-6)
    for name in ("square plate, broadside", "disc, broadside"):
        assert found[name] == pytest.approx(before[name] * 1.17 / 1.05)
    # Friction on a blunt body, which it is not.
    assert found["REMUS 100, ahead"] == pytest.approx(1.5 / 0.42, rel=0.01)


def test_a_plate_sinks_by_its_drag():
    """Terminal speeds are within 10 % of what the measured C_d gives."""
    row = measured_cases.sinking_plate("faces")
    assert row.ours == pytest.approx(row.measured * np.sqrt(1.16 / 1.05), rel=1e-3)
    # One that remembers how it began to sink is still a little slower than by its C_d of 1.17.
    found = measured_cases.sinking_plate()
    assert 0.94 < found.ours / (found.measured * np.sqrt(1.16 / 1.17)) < 1.0
    assert all(abs(x.ratio - 1) < 0.1 for x in (row, found))


def test_plates_lift_as_measured_before_they_stall():
    polars = measured_cases.polars(drag="faces")
    for polar in data.POLARS:
        angle, lift = polars.lines[polar.module, "lift"]
        ours = np.interp(polar.angle, angle, lift)
        low = (np.array(polar.angle) > 0) & (np.array(polar.angle) <= 10)
        share = ours[low] / np.array(polar.lift)[low]
        assert ((share > 0.85) & (share < 1.15)).all()
    # Their stall is at 30°, that of a plate of aspect ratio 2 near 18°: it lifts too much there.
    assert 1.5 < ratios(polars.rows)["lift, aspect 2, 25°"] < 1.9


@pytest.mark.long
def test_a_chain_glides_as_far_as_measured():
    found = ratios(measured_cases.amphibot_glide().rows)
    assert all(abs(x - 1) < 0.04 for name, x in found.items() if "way" in name)
    assert found["glide, rotation after 4.4 s"] == pytest.approx(2.01, abs=0.02)


@pytest.mark.slow
def test_a_chain_that_swims():
    chain = measured_cases.body("ChainHead", measured_cases._pool("cross_flow"), "ChainModule", 6)
    [speed], error = measured_cases.swim(chain, [data.AMPHIBOT_SWIM], settle=3.0)
    assert speed / data.AMPHIBOT_SWIM.speed == pytest.approx(0.96, abs=0.01)
    assert error < 0.02  # the joints do what is prescribed


def test_a_flapping_foil_thrusts_too_much_unless_its_lift_lags():
    found = ratios(measured_cases.foil("faces"))
    assert 1.5 < found["C_T, Schouveiler"] < 1.75
    assert 1.65 < found["C_T, Read"] < 1.85
    # Drag has no thrust, and none is without power.
    assert 0.0 < found["η, Read"] * 0.43 < 1.0
    found = ratios(measured_cases.foil(phases=256))
    assert all(abs(found[f"C_T, {who}"] - 1) < 0.2 for who in ("Schouveiler", "Read"))


def test_an_oscillating_plate_drags_several_times_too_little_unless_it_remembers():
    found = measured_cases.oscillating((8, 30), "faces")
    # Whatever the number: ours knows no vortices that stay with the plate.
    np.testing.assert_allclose(found.lines["faces"][1], 1.05, rtol=1e-3)
    assert 0.2 < ratios(found.rows)["C_d of a plate, U T / b = 8"] < 0.22
    assert data.plate_drag(1000.0) == 1.95  # a steady two-dimensional plate
    few = (3, 5, 8, 15, 30, 60)
    found = ratios(measured_cases.oscillating(few).rows)
    for number in few:
        name = f"C_d of a plate, U T / b = {number}"
        assert min(abs(found[x] - 1) for x in (name, f"{name}, bilge keels")) < 0.1


@pytest.mark.slow
def test_a_ships_section_bobs_too_slowly_and_rolls_too_far():
    """Half out, a box carries too much water, and makes no waves that would damp it."""
    found = ratios(measured_cases.section_periods())
    assert found["period in heave"] == pytest.approx(1.22, abs=0.03)
    assert found["period in roll"] == pytest.approx(1.02, abs=0.03)
    heave, roll = measured_cases.section_in_waves(0.55)
    assert heave < 0.4 * 19.3
    assert 1.3 * 11.6 < roll < 1.8 * 11.6
    # In long waves it goes with them: at ξ = .05 the wave is 60 breadths long.
    heave, _ = measured_cases.section_in_waves(0.05)
    assert heave == pytest.approx(1e3 * data.WAVE_AMPLITUDE, rel=0.1)
