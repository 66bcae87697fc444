// Decodes an SPZ file by @adobe/spz, in COLMAP's axes: node read_spz.mjs FILE.spz FILE.json
import { readFileSync, writeFileSync } from "node:fs";
import createSpzModule from "@adobe/spz";

const [source, target] = process.argv.slice(2);
const spz = await createSpzModule();
const cloud = spz.loadSpzFromBuffer(new Uint8Array(readFileSync(source)), { to: spz.CoordinateSystem.RDF });
const read = { count: cloud.numPoints, degree: cloud.shDegree, antialiased: cloud.antialiased };
for (const name of ["positions", "scales", "rotations", "alphas", "colors", "sh"]) {
  read[name] = Array.from(cloud[name]);
}
writeFileSync(target, JSON.stringify(read));
