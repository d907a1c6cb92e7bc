//! The pose of a frame: `transform_matrix`, however its sixteen numbers are written, and what is
//! there in its place.

use super::{Fault, Object};
use serde_json::Value;
use tiface_base::io;

/// How a pose has to be written.
const WRITTEN: &str = "camera to world, row by row, its last column the position; the camera has +X right, \
                       +Y up and looks along -Z";

/// Keys of poses of other programs, which are not read: they say neither the direction nor the
/// axes.
const FROM_CAMERA: &[&str] = &[
    "c2w",
    "cam2world",
    "cam_to_world",
    "camera_to_world",
    "camtoworld",
    "camera2world",
    "cameraToWorld",
    "world_from_camera",
    "cameraPoseARFrame",
    "camera_pose",
];

const FROM_WORLD: &[&str] = &[
    "w2c",
    "world2cam",
    "world_2_cam",
    "world_to_cam",
    "world_to_camera",
    "worldtocam",
    "worldToCamera",
    "world_view_transform",
    "view_matrix",
    "viewMatrix",
];

const FROM_EITHER: &[&str] = &[
    "transform",
    "transformMatrix",
    "transformation",
    "transformation_matrix",
    "matrix",
    "pose",
    "poses",
    "pose_matrix",
    "extrinsic",
    "extrinsics",
    "extrinsic_matrix",
    "camera_extrinsics",
    "rotation_matrix",
    "quaternion",
    "qvec",
    "tvec",
    "R",
    "T",
    "Rt",
];

/// All keys that are named where there is no `transform_matrix`.
pub(super) fn names() -> impl Iterator<Item = &'static str> {
    [FROM_CAMERA, FROM_WORLD, FROM_EITHER].into_iter().flatten().copied()
}

/// Returns the upper three rows of the pose of a frame.
pub(super) fn rows(own: &Object) -> Result<[[f64; 4]; 3], Fault> {
    let Some(value) = own.get("transform_matrix").filter(|value| !value.is_null()) else {
        return Err(missing(own));
    };
    let list = value.as_array().map(Vec::as_slice).unwrap_or_default();
    let flat: Option<Vec<f64>> = list.iter().take(17).map(Value::as_f64).collect();
    if let Some(flat) = flat.filter(|flat| [12, 16].contains(&flat.len())) {
        let rows: Vec<Vec<f64>> = flat.chunks(4).map(<[f64]>::to_vec).collect();
        return upper_rows(&rows);
    }
    let rows: Vec<Vec<f64>> = io::typed(value).map_err(|[key, found, expected]| {
        let key = key.trim_start_matches('.');
        format!("its `transform_matrix{key}` is {found}, expected {expected}")
    })?;
    upper_rows(&rows)
}

/// Returns the mistake of a frame without `transform_matrix`, with what may be one.
fn missing(own: &Object) -> Fault {
    let text = "it has no `transform_matrix`".to_string();
    let Some(key) = names().find(|key| own.contains_key(*key)) else { return Fault::Frame(text) };
    let is_in = |keys: &[&str]| keys.contains(&key);
    let inverse = "invert it (`numpy.linalg.inv`)";
    let way = if is_in(FROM_CAMERA) {
        "rename it".into()
    } else if is_in(FROM_WORLD) {
        inverse.into()
    } else {
        format!("rename it if it is that already, or {inverse} if it is world to camera")
    };
    Fault::File {
        text: format!("{text}, and `{key}` is not read, which does not say its axes"),
        hint: format!(
            "write `transform_matrix`: {WRITTEN}. From `{key}`: {way}; if the camera looks along +Z with +Y \
             down (OpenCV, COLMAP), then negate the second and third column"
        ),
    }
}

/// Returns the upper three rows of a 3×4 or 4×4 matrix.
fn upper_rows(matrix: &[Vec<f64>]) -> Result<[[f64; 4]; 3], Fault> {
    let rows: Option<Vec<[f64; 4]>> = matrix.iter().map(|row| row.as_slice().try_into().ok()).collect();
    let ([a, b, c], last) = match rows.as_deref() {
        Some(&[a, b, c]) => ([a, b, c], [0.0, 0.0, 0.0, 1.0]),
        Some(&[a, b, c, last]) => ([a, b, c], last),
        _ if matrix.len() == 4 && matrix.iter().all(|row| row.len() == 3) => {
            return Err(transposed("it has four rows of three numbers"));
        }
        _ => return Err(Fault::Frame("its `transform_matrix` is not 4 × 4 or 3 × 4 numbers".into())),
    };
    if is_end(last) {
        return Ok([a, b, c]);
    }
    if is_end([a[3], b[3], c[3], last[3]]) {
        return Err(transposed("its last column is 0 0 0 1, and its last row is not"));
    }
    Err(Fault::Frame(format!("the last row of its `transform_matrix` is {last:?}, not 0 0 0 1")))
}

/// Returns whether numbers are 0 0 0 1.
fn is_end(numbers: [f64; 4]) -> bool {
    numbers.iter().zip([0.0, 0.0, 0.0, 1.0]).all(|(v, end)| (v - end).abs() <= 1e-6)
}

/// Returns the mistake of columns in the place of rows, as ARKit and OpenGL store matrices.
fn transposed(how: &str) -> Fault {
    Fault::File {
        text: format!("its `transform_matrix` is transposed, columns in the place of rows: {how}"),
        hint: format!(
            "write the transposed matrices (`numpy.array(matrix).T.tolist()`): {WRITTEN}; ARKit's are that, \
             once transposed"
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn found(matrix: Value) -> Result<[[f64; 4]; 3], String> {
        rows(json!({ "transform_matrix": matrix }).as_object().unwrap()).map_err(|fault| match fault {
            Fault::Frame(text) => text,
            Fault::File { text, hint } => format!("{text}; {hint}"),
            Fault::Error(error) => error.to_string(),
        })
    }

    #[test]
    fn matrices_of_three_and_four_rows_and_flat_ones_are_read() {
        let three = [[1., 0., 0., 5.], [0., 1., 0., 6.], [0., 0., 1., 7.]];
        let four = |last: [f64; 4]| [&three[..], &[last]].concat();
        assert_eq!(found(json!(three)).unwrap(), three);
        assert_eq!(found(json!(four([0., 0., 0., 1.]))).unwrap(), three);
        assert_eq!(found(json!(three.concat())).unwrap(), three);
        assert_eq!(found(json!(four([0., 0., 0., 1.]).concat())).unwrap(), three);
        assert!(found(json!(four([0., 0., 1., 1.]))).unwrap_err().contains("last row"));
        assert!(found(json!([])).unwrap_err().contains("4 × 4"));
        assert_eq!(
            found(json!([[1, "x"]])).unwrap_err(),
            "its `transform_matrix[0][1]` is \"x\", expected a number"
        );
        assert_eq!(found(json!("eye")).unwrap_err(), "its `transform_matrix` is \"eye\", expected a list");
    }

    #[test]
    fn a_transposed_matrix_is_named_as_one() {
        let columns = [[1., 0., 0., 0.], [0., 1., 0., 0.], [0., 0., 1., 0.], [5., 6., 7., 1.]];
        for matrix in [json!(columns), json!(columns.concat()), json!(columns.map(|c| [c[0], c[1], c[2]]))] {
            assert!(found(matrix).unwrap_err().contains("transposed"));
        }
    }

    #[test]
    fn poses_by_other_names_are_named_with_what_to_do() {
        let way = |key: &str| {
            let Fault::File { text, hint } = rows(json!({ key: [1] }).as_object().unwrap()).unwrap_err()
            else {
                panic!("{key}")
            };
            assert!(text.contains("no `transform_matrix`") && text.contains(key), "{text}");
            hint
        };
        assert!(way("c2w").contains("rename it;"));
        assert!(way("world_to_camera").contains("invert it"));
        assert!(way("extrinsics").contains("rename it if") && way("extrinsics").contains("invert"));
        assert!(matches!(rows(&Object::new()), Err(Fault::Frame(_))));
    }
}
