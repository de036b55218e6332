// SPDX-License-Identifier: Apache-2.0
// Prints, as JSON, what the reference reader finds in a log: for each topic the schema, the count,
// and a digest of the times and data in the order in which they are read.
import {McapIndexedReader} from '@mcap/core';
import {FileHandleReadable} from '@mcap/nodejs';
import {decompress} from 'fzstd';
import {createHash} from 'node:crypto';
import {open} from 'node:fs/promises';

const file = await open(process.argv[2]);
const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(file),
  decompressHandlers: {zstd: (data, size) => decompress(data, new Uint8Array(Number(size)))},
});
const topics = {};
for await (const message of reader.readMessages({validateCrcs: true})) {
  const channel = reader.channelsById.get(message.channelId);
  topics[channel.topic] ??= {
    schema: reader.schemasById.get(channel.schemaId).name, count: 0, digest: createHash('sha256'),
  };
  const topic = topics[channel.topic];
  topic.count += 1;
  topic.digest.update(String(message.logTime)).update(message.data);
}
for (const topic of Object.values(topics)) topic.digest = topic.digest.digest('hex');
const metadata = {};
for await (const record of reader.readMetadata()) {
  metadata[record.name] = Object.fromEntries(record.metadata);
}
await file.close();
console.log(JSON.stringify({
  library: reader.header.library, total: Number(reader.statistics.messageCount), topics, metadata,
}));
