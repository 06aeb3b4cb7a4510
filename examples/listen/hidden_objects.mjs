// Hidden objects of a recording, scan by scan: node hidden_objects.mjs seen.mcap
// npm install @mcap/core @mcap/nodejs @mcap/support @msgpack/msgpack
import { open } from "node:fs/promises";
import { argv, exit } from "node:process";
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";
import { decode } from "@msgpack/msgpack";

if (argv.length !== 3) {
  console.error("usage: node hidden_objects.mjs RECORDING.mcap");
  exit(2);
}
const file = await open(argv[2], "r");
const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(file),
  decompressHandlers: await loadDecompressHandlers(),
});
for await (const message of reader.readMessages({ topics: ["perception/hidden_objects"] })) {
  const view = decode(message.data, { useBigInt64: true });
  const places = view.objects.map((one) => `${one.x_m.toFixed(1)}, ${one.y_m.toFixed(1)} m`);
  console.log(`scan ${view.scan_id}: ${places.join("; ") || "nothing hidden"}`);
}
await file.close();
