//! Refractive indices n + ik of metals, measured at room temperature. The values are from
//! refractiveindex.info (public domain).

/// Table of wavelength (nm), n and k in ascending order of wavelength, with its source.
struct RefractiveIndexTable {
    name: &'static str,
    source: &'static str,
    values: &'static [[f64; 3]],
}

const TABLES: [RefractiveIndexTable; 4] = [
    RefractiveIndexTable {
        name: "aluminium",
        source: "Rakić 1995, Appl. Opt. 34, 4755",
        values: &[
            [364.66, 0.39877, 4.3957],
            [413.28, 0.52135, 5.0008],
            [442.80, 0.60790, 5.3676],
            [476.87, 0.72780, 5.7781],
            [516.60, 0.87340, 6.2418],
            [563.57, 1.0728, 6.7839],
            [619.93, 1.3660, 7.4052],
            [652.25, 1.5724, 7.7354],
            [688.81, 1.8301, 8.0601],
            [729.32, 2.1606, 8.3565],
            [774.91, 2.6154, 8.4914],
            [794.78, 2.7675, 8.3866],
            [815.69, 2.7668, 8.2573],
            [837.74, 2.6945, 8.1878],
            [885.61, 2.2802, 8.1134],
            [911.66, 1.9739, 8.3058],
        ],
    },
    RefractiveIndexTable {
        name: "copper",
        source: "Johnson & Christy 1972, Phys. Rev. B 6, 4370",
        values: &[
            [367.9, 1.36, 1.975],
            [381.5, 1.33, 2.045],
            [397.4, 1.32, 2.116],
            [413.3, 1.28, 2.207],
            [430.5, 1.25, 2.305],
            [450.9, 1.24, 2.397],
            [471.4, 1.25, 2.483],
            [495.9, 1.22, 2.564],
            [520.9, 1.18, 2.608],
            [548.6, 1.02, 2.577],
            [582.1, 0.70, 2.704],
            [616.8, 0.30, 3.205],
            [659.5, 0.22, 3.747],
            [704.5, 0.21, 4.205],
            [756.0, 0.24, 4.665],
            [821.1, 0.26, 5.180],
            [892.0, 0.30, 5.768],
        ],
    },
    RefractiveIndexTable {
        name: "iron",
        source: "Johnson & Christy 1974, Phys. Rev. B 9, 5056",
        values: &[
            [368.0, 2.02, 2.43],
            [381.0, 2.12, 2.50],
            [397.0, 2.24, 2.58],
            [413.0, 2.35, 2.65],
            [431.0, 2.48, 2.71],
            [451.0, 2.59, 2.77],
            [471.0, 2.67, 2.82],
            [496.0, 2.74, 2.88],
            [521.0, 2.86, 2.91],
            [549.0, 2.95, 2.93],
            [582.0, 2.94, 2.99],
            [617.0, 2.88, 3.05],
            [659.0, 2.92, 3.10],
            [704.0, 2.86, 3.19],
            [756.0, 2.87, 3.28],
            [821.0, 2.94, 3.39],
            [892.0, 2.96, 3.56],
        ],
    },
    RefractiveIndexTable {
        name: "titanium",
        source: "Johnson & Christy 1974, Phys. Rev. B 9, 5056",
        values: &[
            [368.0, 1.90, 2.90],
            [381.0, 1.99, 2.93],
            [397.0, 2.08, 2.95],
            [413.0, 2.14, 2.98],
            [431.0, 2.21, 3.01],
            [451.0, 2.27, 3.04],
            [471.0, 2.32, 3.10],
            [496.0, 2.36, 3.19],
            [521.0, 2.44, 3.30],
            [549.0, 2.54, 3.43],
            [582.0, 2.60, 3.58],
            [617.0, 2.67, 3.72],
            [659.0, 2.76, 3.84],
            [704.0, 2.86, 3.96],
            [756.0, 3.00, 4.01],
            [821.0, 3.21, 4.01],
            [892.0, 3.29, 3.96],
        ],
    },
];

/// Returns the names of the tabulated metals.
pub fn names() -> impl Iterator<Item = &'static str> {
    TABLES.iter().map(|table| table.name)
}

/// Range of wavelengths, nm, in which all metals are tabulated.
pub const WAVELENGTHS_NM: [f64; 2] = [368.0, 892.0];

/// Returns n, k and their source for the metal `name`, interpolated linearly between measured
/// wavelengths. Returns `None` for unknown metals and for wavelengths outside [`WAVELENGTHS_NM`].
pub fn index(name: &str, wavelength_nm: f64) -> Option<(f64, f64, &'static str)> {
    let [shortest, longest] = WAVELENGTHS_NM;
    let table = TABLES.iter().find(|table| table.name == name)?;
    if !(shortest..=longest).contains(&wavelength_nm) {
        return None;
    }
    let after = table.values.partition_point(|v| v[0] <= wavelength_nm);
    let after = after.min(table.values.len() - 1);
    let ([from, n0, k0], [to, n1, k1]) = (table.values[after - 1], table.values[after]);
    let share = (wavelength_nm - from) / (to - from);
    let between = |a: f64, b: f64| a + (b - a) * share;
    Some((between(n0, n1), between(k0, k1), table.source))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::fresnel::conductor;

    #[test]
    fn measured_values_come_back_and_others_lie_between() {
        assert_eq!(
            index("copper", 659.5).map(|(n, k, _)| (n, k)),
            Some((0.22, 3.747))
        );
        for name in names() {
            for wavelength in WAVELENGTHS_NM {
                assert!(index(name, wavelength).is_some(), "{name} {wavelength}");
            }
            for wavelength in [405.0, 450.0, 520.0, 660.0, 850.0] {
                let (n, k, _) = index(name, wavelength).unwrap();
                let reflectance = conductor(n, k, 1.0);
                assert!((0.4..0.99).contains(&reflectance), "{name} {reflectance}");
            }
            assert!(index(name, 1064.0).is_none() && index(name, f64::NAN).is_none());
        }
        assert!(index("adamantium", 660.0).is_none());
        // Midpoint of 652.25 and 688.81 nm.
        let (n, k, _) = index("aluminium", 670.53).unwrap();
        assert!((n - 1.70125).abs() < 1e-9 && (k - 7.89775).abs() < 1e-9);
        let rising = |table: &RefractiveIndexTable| table.values.is_sorted_by(|a, b| a[0] < b[0]);
        assert!(TABLES.iter().all(rising));
    }
}
