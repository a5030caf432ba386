// The Khronos validator's opinion; run in a folder whose node_modules has gltf-validator.
import { createRequire } from "node:module";
import fs from "node:fs";

const validator = createRequire(process.cwd() + "/")("gltf-validator");
const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])));
console.log(JSON.stringify({ version: validator.version(), ...report.issues }));
