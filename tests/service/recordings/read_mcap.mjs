// Reads a recording as Foxglove does, with its own libraries: `node read_mcap.mjs NODE_MODULES FILE` prints what it found.
// NODE_MODULES is a folder with `npm install @mcap/core @mcap/support @foxglove/schemas protobufjs`.
import fs from "fs";
import path from "path";
import { createRequire } from "module";

const require = createRequire(path.resolve(process.argv[2], "x.js"));
const { McapIndexedReader } = require("@mcap/core");
const { loadDecompressHandlers, protobufFromBinaryDescriptor } = require("@mcap/support");
const published = Object.values(require("@foxglove/schemas/jsonschema"));

const file = fs.readFileSync(process.argv[3]);
const readable = {
  size: async () => BigInt(file.length),
  read: async (at, length) => new Uint8Array(file.subarray(Number(at), Number(at + length))),
};

function reading(channel, schema) {
  if (channel.messageEncoding === "json") return (data) => JSON.parse(new TextDecoder().decode(data));
  const root = protobufFromBinaryDescriptor(schema.data);
  root.resolveAll();
  const type = root.lookupType(schema.name);
  return (data) => type.toObject(type.decode(data), { defaults: true });
}

const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers: await loadDecompressHandlers() });
const found = {};
const readers = new Map();
for (const channel of reader.channelsById.values()) {
  const schema = reader.schemasById.get(channel.schemaId);
  readers.set(channel.id, reading(channel, schema));
  const known = published.find((other) => other.title === schema.name);
  found[channel.topic] = { schema: schema.name, published: known ? Object.keys(known.properties).sort() : null, n: 0 };
}
for await (const message of reader.readMessages()) {
  const entry = found[reader.channelsById.get(message.channelId).topic];
  const value = readers.get(message.channelId)(message.data);
  entry.n += 1;
  entry.keys = Object.keys(value).sort();
  if (value.timestamp) {
    const time = BigInt(value.timestamp.seconds.toString()) * 1000000000n + BigInt(value.timestamp.nanos);
    entry.wrong_times = (entry.wrong_times ?? 0) + Number(time !== message.logTime);
  }
  if (value.format) entry.format = value.format;
  if (value.encoding) entry.encoding = value.encoding;
}
console.log(JSON.stringify(found));
