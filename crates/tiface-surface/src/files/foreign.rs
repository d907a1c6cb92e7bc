//! Formats that are not read, by their first bytes, each with a way to one that is.

use std::path::Path;
use tiface_base::Error;

const BY_BLENDER: &str = "open it in Blender (File, Import) and export it as glTF 2.0 (.glb)";
const BY_MESHLAB: &str = "open it in MeshLab and export it as .ply or .obj";
const AGAIN_AS_GLB: &str =
    "export it as .glb from the program that made it; or import it into Blender and export glTF 2.0";

/// First bytes, or first word, of formats that are not read; what they are called, and a way.
const FORMATS: [(&[u8], &str, &str); 16] = [
    (b"Kaydara FBX Binary", "FBX", BY_BLENDER),
    (b"; FBX", "FBX as text", "Blender does not read it: save it as binary FBX, or export it as .glb"),
    (b"BLENDER", "a Blender file", "open it in Blender and export it as glTF 2.0 (.glb)"),
    (
        b"\x28\xb5\x2f\xfd",
        "a compressed file (Zstandard), as Blender saves",
        "open it in Blender and export it as glTF 2.0 (.glb)",
    ),
    (b"PXR-USDC", "USD", BY_BLENDER),
    (b"#usda", "USD", BY_BLENDER),
    (
        b"PK\x03\x04",
        "a zip: USDZ, 3MF or an archive",
        "unpack an archive; open USDZ in Blender and 3MF in MeshLab, and export them as .glb or .ply",
    ),
    (b"OFF", "OFF", BY_MESHLAB),
    (b"COFF", "OFF", BY_MESHLAB),
    (b"NOFF", "OFF", BY_MESHLAB),
    (b"STOFF", "OFF", BY_MESHLAB),
    (b"#VRML", "VRML", BY_MESHLAB),
    (b"<?xml", "XML, such as COLLADA or X3D", AGAIN_AS_GLB),
    (
        b"# .PCD",
        "a point cloud (PCD)",
        "make a surface of it first, in CloudCompare or MeshLab, and save that as .ply",
    ),
    (
        b"LASF",
        "a point cloud (LAS)",
        "make a surface of it first, in CloudCompare or MeshLab, and save that as .ply",
    ),
    (
        b"ASTM-E57",
        "a point cloud (E57)",
        "make a surface of it first, in CloudCompare or MeshLab, and save that as .ply",
    ),
];

/// Returns the error for a format that is known, but not read.
pub(super) fn refusal(bytes: &[u8], path: &Path) -> Option<Error> {
    let shown = path.display();
    if bytes.starts_with(&[0xff, 0xfe]) || bytes.starts_with(&[0xfe, 0xff]) {
        let what = format!("`{shown}` is text in UTF-16, and meshes are read in UTF-8");
        return Some(Error::cannot(what, "save it as UTF-8, or export it again"));
    }
    let text = bytes.trim_ascii_start();
    if text.starts_with(b"{") && bytes[..bytes.len().min(1 << 16)].windows(7).any(|w| w == b"\"asset\"") {
        let what = format!("`{shown}` is a .gltf, whose numbers lie in another file");
        return Some(Error::cannot(what, "export it as .glb, which holds all in one"));
    }
    let (_, name, way) = FORMATS.iter().find(|(first, ..)| {
        // a word ends where letters do: `OFF` is a format, `OFFSET` is not
        text.strip_prefix(*first)
            .is_some_and(|rest| !first.ends_with(b"OFF") || rest.first().is_none_or(u8::is_ascii_whitespace))
    })?;
    Some(Error::cannot(format!("`{shown}` is {name}, which is not read"), *way))
}
