"""The keys pos1-, pos2- and stats-, and one of misc-: what the solver does. One row, one line: it is a table."""

from typing import Final

from rtkmesh_services.conf import choices as c
from rtkmesh_services.conf.rows import Fate, Kind, Row

_T, _R, _I = Fate.TAKEN, Fate.TRANSLATED, Fate.IGNORED
_NUM, _INT, _TEXT, _ENUM = Kind.NUMBER, Kind.INTEGER, Kind.TEXT, Kind.CHOICE
_MASK: Final = "0,0,0,0,0,0,0,0,0"
_ONE_MASK: Final = (
    "one mask for all elevations and bands, of rover and base: the smallest of the values, so that nothing is left out that RTKLIB uses"
)
_SPP: Final = "there is no option: the broadcast model (Klobuchar) serves single positions, double differences of short baselines need none"
_OWN_TEST: Final = "innovations are tested by their own statistics (docs/concepts/engine.md), not by limits in metres"
_OWN_SLIPS: Final = "slips are found by time differences of phases against all satellites, without a threshold to set"
_PPP: Final = "of PPP, which there is not"
_GLO: Final = "GLONASS is always tried in the integer search, with a slope per band that is learned, and kept where the evidence is for it"

# fmt: off
ROWS: Final = (
    Row("pos1-posmode", _ENUM, "kinematic", _T, "solver.mode", "movingbase is moving-base; PPP is refused", "single", c.MODES),
    Row("pos1-frequency", _ENUM, "l1+l2", _T, "solver.frequencies", "how many bands per satellite; the best ones that both receivers have, not fixed slots", None, c.FREQUENCIES),
    Row("pos1-soltype", _ENUM, "forward", _R, "", "of recordings: rtkmesh solve --direction; a live solver goes forward", None, c.DIRECTIONS),
    Row("pos1-elmask", _NUM, "15", _T, "solver.elevation_mask_deg"),
    Row("pos1-snrmask_r", _ENUM, "off", _R, "solver.cn0_mask_dbhz", "switches the mask that the values give", None, c.SWITCH),
    Row("pos1-snrmask_b", _ENUM, "off", _R, "solver.cn0_mask_dbhz", "the mask counts for rover and base together", None, c.SWITCH),
    Row("pos1-snrmask_L1", _TEXT, _MASK, _R, "solver.cn0_mask_dbhz", _ONE_MASK),
    Row("pos1-snrmask_L2", _TEXT, _MASK, _R, "solver.cn0_mask_dbhz", _ONE_MASK),
    Row("pos1-snrmask_L5", _TEXT, _MASK, _R, "solver.cn0_mask_dbhz", _ONE_MASK),
    Row("pos1-snrmask_L6", _TEXT, _MASK, _R, "solver.cn0_mask_dbhz", _ONE_MASK, only="demo5"),
    Row("pos1-dynamics", _ENUM, "on", _R, "", "velocity and acceleration are always estimated; off: no process noise is taken from the file", "off", c.SWITCH),
    Row("pos1-tidecorr", _INT, "0", _R, "", "2.4's off/on/otl and demo5's bits; solid tides of rover and base are always applied, ocean loading and pole tides never", None, c.TIDES_OLD),
    Row("pos1-ionoopt", _ENUM, "brdc", _I, "", _SPP, "off", c.IONOSPHERE),
    Row("pos1-tropopt", _ENUM, "saas", _I, "", "there is no option: Saastamoinen, and a wet zenith delay that is estimated as the baseline needs it", "off", c.TROPOSPHERE),
    Row("pos1-sateph", _ENUM, "brdc", _I, "", "broadcast ephemerides are what there is; precise orbits, SBAS and SSR corrections are not read", None, c.ORBITS),
    Row("pos1-posopt1", _ENUM, "off", _I, "", f"satellite antennas, {_PPP}", None, c.SWITCH),
    Row("pos1-posopt2", _ENUM, "off", _R, "", "calibrations of receivers' antennas are always applied where the antenna is known", None, c.SWITCH),
    Row("pos1-posopt3", _ENUM, "off", _I, "", f"phase wind-up, {_PPP}", None, c.SWITCH_PRECISE),
    Row("pos1-posopt4", _ENUM, "off", _I, "", f"eclipsing satellites, {_PPP}", None, c.SWITCH),
    Row("pos1-posopt5", _ENUM, "off", _R, "", "single positions always exclude faulty satellites", None, c.SWITCH),
    Row("pos1-posopt6", _ENUM, "off", _I, "", f"clock jumps of the day's boundary, {_PPP}", None, c.SWITCH),
    Row("pos1-exclsats", _TEXT, "", _T, "solver.excluded", "`+` (use although unhealthy) is not possible"),
    Row("pos1-navsys", _INT, "45", _T, "solver.systems", "bits 1 GPS, 2 SBAS, 4 GLONASS, 8 Galileo, 16 QZSS, 32 BeiDou, 64 NavIC", "1"),
    Row("pos2-armode", _ENUM, "fix-and-hold", _T, "solver.ambiguity.mode", "", "continuous", c.AMBIGUITIES, tuning=True),
    Row("pos2-gloarmode", _ENUM, "fix-and-hold", _I, "", _GLO, "on", c.GLONASS_AMBIGUITIES),
    Row("pos2-bdsarmode", _ENUM, "off", _I, "", "BeiDou always takes part in the integer search; systems leaves it out altogether", "on", c.SWITCH),
    Row("pos2-arfilter", _ENUM, "on", _I, "", "new satellites enter a fix only by their own evidence", None, c.SWITCH, "demo5"),
    Row("pos2-arthres", _NUM, "3", _T, "solver.ambiguity.ratio", "scales the confidence asked for: 3 asks for ours"),
    Row("pos2-arthresmin", _NUM, "3", _I, "", "the threshold follows the model's strength by itself", only="demo5"),
    Row("pos2-arthresmax", _NUM, "3", _I, "", "the threshold follows the model's strength by itself", only="demo5"),
    Row("pos2-arthres1", _NUM, "0.25", _I, "", "demo5: largest position variance for the search, 2.4: a success rate of PPP; here the search's own success rate decides", "0.9999"),
    Row("pos2-arthres2", _NUM, "0", _I, "", _GLO, "0.25"),
    Row("pos2-arthres3", _NUM, "1e-09", _I, "", _GLO, "0.1"),
    Row("pos2-arthres4", _NUM, "1e-05", _I, "", _GLO, "0.05"),
    Row("pos2-varholdamb", _NUM, "0.1", _I, "", "ambiguities are held with 0.1 cyc2, demo5's default", only="demo5"),
    Row("pos2-gainholdamb", _NUM, "0.01", _I, "", _GLO, only="demo5"),
    Row("pos2-arlockcnt", _INT, "0", _T, "solver.ambiguity.minimum_lock_epochs", "", tuning=True),
    Row("pos2-minfixsats", _INT, "4", _R, "solver.ambiguity.minimum_ambiguities", "satellites less one is ambiguities; without it 5: fewer are wrong more often than right", only="demo5", tuning=True),
    Row("pos2-minholdsats", _INT, "5", _I, "", "a hold needs what a fix needs", only="demo5"),
    Row("pos2-mindropsats", _INT, "10", _I, "", "subsets are tried whenever the whole set gives no fix", only="demo5"),
    Row("pos2-arelmask", _NUM, "0", _T, "solver.ambiguity.elevation_mask_deg", "", tuning=True),
    Row("pos2-arminfix", _INT, "20", _T, "solver.ambiguity.hold_after_epochs", "", "10", tuning=True),
    Row("pos2-armaxiter", _INT, "1", _I, "", "RTKLIB does not use it in RTK either"),
    Row("pos2-elmaskhold", _NUM, "0", _I, "", "what is fixed may be held"),
    Row("pos2-aroutcnt", _INT, "20", _I, "", "ambiguities survive gaps of up to 20 s, tested when they end, not counted in epochs", "5"),
    Row("pos2-maxage", _NUM, "30", _T, "solver.max_age_s", "counts in every mode, moving base too (demo5: at most 1.05 s there)"),
    Row("pos2-syncsol", _ENUM, "off", _T, "solver.sync.matched_only", "RTKLIB reads it and does nothing, rtkrcv_ros and we do", None, c.SWITCH),
    Row("pos2-slipthres", _NUM, "0.05", _I, "", _OWN_SLIPS),
    Row("pos2-dopthres", _NUM, "0", _I, "", _OWN_SLIPS, only="demo5"),
    Row("pos2-rejionno", _NUM, "5", _I, "", f"2.4: one limit of code and phase, 30 m; demo5: of phase alone, so that 30 switches it off. {_OWN_TEST}", "30"),
    Row("pos2-rejphase", _NUM, "5", _I, "", _OWN_TEST, only="demo5"),
    Row("pos2-rejcode", _NUM, "30", _I, "", _OWN_TEST, only="demo5"),
    Row("pos2-rejgdop", _NUM, "30", _I, "", "the covariance says how good the geometry is", only="2.4"),
    Row("pos2-niter", _INT, "1", _I, "", "the update is iterated as its curvature needs"),
    Row("pos2-baselen", _NUM, "0", _T, "solver.baseline_length_m", "0: unknown"),
    Row("pos2-basesig", _NUM, "0", _T, "solver.baseline_sigma_m", "0: ours, 0.01 m"),
    Row("stats-eratio1", _NUM, "300", _T, "solver.noise.code_ratio", "", "100", tuning=True),
    Row("stats-eratio2", _NUM, "300", _R, "solver.noise.code_ratio", "one ratio for all bands: that of the first", "100", tuning=True),
    Row("stats-eratio5", _NUM, "300", _R, "solver.noise.code_ratio", "one ratio for all bands: that of the first", only="demo5", tuning=True),
    Row("stats-eratio6", _NUM, "300", _R, "solver.noise.code_ratio", "one ratio for all bands: that of the first", only="demo5", tuning=True),
    Row("stats-errphase", _NUM, "0.003", _T, "solver.noise.phase_a_m", "", tuning=True),
    Row("stats-errphaseel", _NUM, "0.003", _T, "solver.noise.phase_b_m", "", tuning=True),
    Row("stats-errphasebl", _NUM, "0", _I, "", "the part that grows with the baseline is the orbits', 0.1 mm per km, and the atmosphere's, which is estimated"),
    Row("stats-errdoppler", _NUM, "1", _I, "", "the noise of Dopplers is learned from their residuals"),
    Row("stats-snrmax", _NUM, "52", _I, "", "noise follows elevation, C/N0 (twice the variance at 34 dB-Hz) and residuals", only="demo5"),
    Row("stats-errsnr", _NUM, "0", _I, "", "noise follows elevation, C/N0 (twice the variance at 34 dB-Hz) and residuals", only="demo5"),
    Row("stats-errrcv", _NUM, "0", _I, "", "the receiver's own sigmas are part of the noise, as they are", only="demo5"),
    Row("stats-stdbias", _NUM, "30", _I, "", "new ambiguities begin with what code and phase say of them"),
    Row("stats-stdiono", _NUM, "0.03", _I, "", "the ionosphere's states have their own"),
    Row("stats-stdtrop", _NUM, "0.3", _I, "", "the zenith delay has its own"),
    Row("stats-prnaccelh", _NUM, "0.1", _T, "solver.dynamics.acceleration_horizontal_mps2", "with pos1-dynamics=on", tuning=True),
    Row("stats-prnaccelv", _NUM, "0.01", _T, "solver.dynamics.acceleration_vertical_mps2", "with pos1-dynamics=on", tuning=True),
    Row("stats-prnbias", _NUM, "0.0001", _T, "solver.dynamics.ambiguity_cyc", "RTKLIB's default of 0.0001 leaves a wrong float sure of itself", tuning=True),
    Row("stats-prniono", _NUM, "0.001", _I, "", "the ionosphere's states have their own"),
    Row("stats-prntrop", _NUM, "0.0001", _I, "", "the zenith delay has its own"),
    Row("stats-prnpos", _NUM, "0", _I, "", _PPP),
    Row("stats-clkstab", _NUM, "5e-12", _I, "", "by the age of the base epoch clocks are taken to drift by as much, 1.5 mm per second"),
    Row("misc-timeinterp", _ENUM, "off", _T, "solver.sync.interpolate", "of recordings: rtkmesh solve does so unless it is told --no-interpolation; live no later base epoch is known", None, c.SWITCH),
)
# fmt: on
