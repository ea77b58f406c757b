"""Units: Å, ps, u, e, K inside, energies in u Å²/ps². Other units appear only in input and output.

`1 kJ/mol = 100 u Å²/ps²` exactly in the limit where the molar mass constant is 1 g/mol (it is to
3e-10, CODATA 2018). Constants: CODATA 2018; N_A, k_B and e are exact since 2019.
"""

from math import pi, sqrt

AVOGADRO = 6.02214076e23  # 1/mol
BOLTZMANN_SI = 1.380649e-23  # J/K
ELEMENTARY_CHARGE = 1.602176634e-19  # C
VACUUM_PERMITTIVITY = 8.8541878128e-12  # F/m, CODATA 2018

KJ_PER_MOL = 100.0  # u Å²/ps²
BOLTZMANN = BOLTZMANN_SI * AVOGADRO * 1e-3 * KJ_PER_MOL  # u Å²/ps² per K
# u Å³/ps² per e²
COULOMB = (
    ELEMENTARY_CHARGE**2 * AVOGADRO / (4 * pi * VACUUM_PERMITTIVITY) * 1e10 * 1e-3 * KJ_PER_MOL
)
COULOMB_CHARGE = sqrt(COULOMB)  # one e, in units where q²/r is an energy in u Å²/ps²

#: One debye in e Å: 1e-21 C m²/s over the speed of light and e (1 e Å = 4.80320471 D).
DEBYE = 1e-21 / 299792458 / ELEMENTARY_CHARGE * 1e10  # e Å

FEMTOSECOND = 1e-3  # ps
BAR = 1e5 * AVOGADRO * 1e-30 * 1e-3 * KJ_PER_MOL  # u/(Å ps²)
GRAM_PER_CM3 = AVOGADRO * 1e-24  # u/Å³

#: Units of `rigidmd energy --unit`: name -> size in u Å²/ps².
ENERGY_UNITS = {
    "kJ/mol": KJ_PER_MOL,
    "kcal/mol": 4.184 * KJ_PER_MOL,
    "eV": ELEMENTARY_CHARGE * AVOGADRO * 1e-3 * KJ_PER_MOL,
    "K": BOLTZMANN,
}

VOLT_PER_NM = ENERGY_UNITS["eV"] / 10  # u Å/ps² on a charge e
METRE_PER_S2 = 1e-14  # Å/ps²
