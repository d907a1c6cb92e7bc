// Khronos' own validator on GLB files: no errors, no warnings, no infos.
//
//     npm ci --prefix tools/readers
//     node tools/readers/validate.mjs DIR/sphere.glb ...

import { readFile } from "node:fs/promises";
import { validateBytes, version } from "gltf-validator";

let wrong = 0;
console.log(`gltf-validator ${version()}`);
for (const path of process.argv.slice(2)) {
  const report = await validateBytes(new Uint8Array(await readFile(path)), { uri: path });
  const { numErrors, numWarnings, numInfos, numHints, messages } = report.issues;
  console.log(`${path}: ${numErrors} errors, ${numWarnings} warnings, ${numInfos} infos, ${numHints} hints`);
  for (const { code, message, pointer } of messages) console.log(`  ${code} ${pointer ?? ""}: ${message}`);
  wrong += numErrors + numWarnings + numInfos;
}
if (process.argv.length < 3) {
  console.log("which files?");
  wrong = 1;
}
process.exit(wrong ? 1 : 0);
