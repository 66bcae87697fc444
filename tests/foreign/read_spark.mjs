// Reads an SPZ by Spark and writes it again: node read_spark.mjs FILE OUT. Prints why it cannot be read.
import fs from "node:fs";

for (const name of ["window", "self", "document"]) globalThis[name] ??= globalThis; // of a browser
const { SplatFileType, transcodeSpz } = await import("@sparkjsdev/spark");
const [file, out] = process.argv.slice(2);
const inputs = [{ fileBytes: new Uint8Array(fs.readFileSync(file)), fileType: SplatFileType.SPZ }];
for (let tries = 0; ; tries++) {
  try {
    fs.writeFileSync(out, (await transcodeSpz({ inputs })).fileBytes);
    process.exit(0);
  } catch (error) {
    if (tries < 600 && String(error).includes("__wbindgen")) { // its WebAssembly is still being compiled
      await new Promise((done) => setTimeout(done, 100));
      continue;
    }
    console.log(String(error));
    process.exit(1);
  }
}
