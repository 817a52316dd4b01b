// Calls the fusion interface of DB34/T 4101-2022: adds a property, sets a calibration, sends a picture with a cloud and
// the boxes that detectors saw in both, and reads what both fusions make of them.
//
//     node client.js HOST:PORT [fusion.proto]
//
// It knows the .proto and nothing else of the service.
"use strict";

const path = require("node:path");
const grpc = require("@grpc/grpc-js");
const loader = require("@grpc/proto-loader");

const PROTO = path.join(__dirname, "../../../proto/sceneloom/db34t4101/v1/fusion.proto");
const LARGEST_MESSAGE = 256 * 1024 * 1024; // gRPC takes 4 MB unless told otherwise
const WAIT_MS = 10000;
const CAMERA = 1;
const LIDAR = 0;
const WIDTH = 64;
const HEIGHT = 48;

function connect(address, proto) {
  // keepCase: the names of the standard, X and x1 among them, stay as they are
  const loaded = loader.loadSync(proto, { keepCase: true, longs: Number, enums: String, defaults: true, oneofs: true });
  const { DataFusion } = grpc.loadPackageDefinition(loaded).sceneloom.db34t4101.v1;
  return new DataFusion(address, grpc.credentials.createInsecure(), {
    "grpc.max_receive_message_length": LARGEST_MESSAGE,
    "grpc.max_send_message_length": LARGEST_MESSAGE,
  });
}

// Gives a function that calls a method with one request and promises its answer.
function callerOf(client, session) {
  return (method, request) =>
    new Promise((resolve, reject) => {
      const deadline = Date.now() + 3 * WAIT_MS;
      client[method]({ ...request, session }, { deadline }, (error, answer) => (error ? reject(error) : resolve(answer)));
    });
}

// Gives the first answer of a stream of results.
function firstOf(client, session, request) {
  return new Promise((resolve, reject) => {
    const call = client.Subscribe({ ...request, session, most: 1 }, { deadline: Date.now() + 3 * WAIT_MS });
    let found = null;
    call.on("data", (answer) => (found = answer));
    call.on("error", reject);
    call.on("end", () => (found ? resolve(found) : reject(new Error("the stream ended without a result"))));
  });
}

async function must(promised, what) {
  const answer = await promised;
  if (answer.status !== 1) throw new Error(`${what}: ${answer.cause}: ${answer.reason}`);
}

// Numbers of 32 bits, little-endian whatever this machine is.
function floats(numbers) {
  const bytes = Buffer.alloc(4 * numbers.length);
  numbers.forEach((number, k) => bytes.writeFloatLE(number, 4 * k));
  return bytes;
}

function records(seq, timestamp) {
  const points = [];
  for (let k = -20; k <= 20; k++) points.push(10 + 0.1 * Math.abs(k), 0.05 * k, 0.0);
  const picture = Buffer.alloc(WIDTH * HEIGHT * 3);
  for (let k = 0; k < picture.length; k += 3) picture.set([200, 100, 50], k);
  const car = { class: "car", confidence: 0.9, timestamp };
  return {
    image: {
      image: { sensor_id: CAMERA, timestamp, seq, height: HEIGHT, width: WIDTH, encoding: "rgb8", channel: 3, data: picture },
    },
    points: {
      points: {
        sensor_id: LIDAR,
        timestamp,
        seq,
        number: points.length / 3,
        fields: ["x", "y", "z"],
        fields_number: 3,
        data: floats(points),
      },
    },
    "2D boxes": {
      boxes_2d: {
        sensor_id: CAMERA,
        seq,
        timestamp,
        boxes: [{ ...car, id: 4, image_seq: seq, x1: 24, y1: 19, x2: 40, y2: 29 }],
      },
    },
    "3D boxes": {
      boxes_3d: {
        sensor_id: LIDAR,
        seq,
        timestamp,
        boxes: [
          {
            ...car,
            id: 7,
            points_seq: seq,
            X: 10,
            Y: 0,
            Z: 0,
            length: 4,
            width: 2,
            height: 1.5,
            direction: [1, 0, 0],
            velocity: 3,
          },
        ],
      },
    },
  };
}

function summary(sensorData, detections, counts) {
  const record = sensorData.sensor_data;
  const depths = [];
  for (let k = 0; k < record.image_depth.length; k += 4) {
    const depth = record.image_depth.readFloatLE(k);
    if (depth > 0) depths.push(depth);
  }
  return {
    sensor_data: {
      number: sensorData.number,
      image_seq: record.image_seq,
      points_seq: record.points_seq,
      size: [record.width, record.height],
      points: record.point_num,
      fields: record.point_fields,
      depths: depths.length,
      nearest_m: Math.min(...depths),
    },
    detections: detections.detections.detections.map((found) => ({
      class: found.class,
      confidence: found.confidence,
      at: [found.X, found.Y, found.Z],
      box_3d_id: found.box_3d_id,
      box_2d_id: found.box_2d_id,
    })),
    counts,
  };
}

async function main(address, proto = PROTO) {
  const session = `javascript-${process.pid}`;
  const client = connect(address, proto);
  const call = callerOf(client, session);
  try {
    // Clauses 5.3 to 5.5.
    const added = { name: "frequency", description: "the capture frequency of sensor", type: "uint32" };
    await must(call("AddProperty", added), "AddProperty");
    await must(call("SetProperty", { name: "frequency", value: { integer_value: 10 } }), "SetProperty");
    const property = await call("GetProperty", { name: "frequency" });
    if (property.value.integer_value !== 10) throw new Error(`GetProperty: ${JSON.stringify(property)}`);
    const refused = await call("SetProperty", { name: "frequency", value: { integer_value: -1 } });
    if (refused.status !== 0) throw new Error("-1 is no uint32, and was taken");

    // Table 3: a camera where the lidar is, looking forward; its extrinsic_matrix column by column.
    const calibration = {
      image_size: [WIDTH, HEIGHT],
      intrinsic_matrix: [50, 0, 31.5, 0, 50, 23.5, 0, 0, 1],
      reference_frame: 0,
      extrinsic_matrix: [0, 0, 1, 0, -1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 1],
    };
    await must(call("SetCalibration", { calibration, camera_id: CAMERA, lidar_id: LIDAR }), "SetCalibration");

    // Clause 5.6.
    const timestamp = { s: 1595682678, ns: 715705367 };
    for (const [what, request] of Object.entries(records(5, timestamp))) await must(call("Send", request), what);
    await must(call("Flush", {}), "Flush");

    // Clause 5.7, both fusion types.
    const sensorData = await call("Get", { fusion_type: 0, wait_ms: WAIT_MS });
    if (sensorData.result !== "sensor_data") throw new Error(`Get: ${sensorData.result}`);
    const detections = await firstOf(client, session, { fusion_type: 1 });
    const { counts } = await call("GetCounters", {});
    console.log(JSON.stringify(summary(sensorData, detections, counts), null, 2));
    await must(call("CloseSession", {}), "CloseSession");
  } finally {
    client.close();
  }
}

const [address, proto] = process.argv.slice(2);
if (!address) {
  console.error("usage: node client.js HOST:PORT [fusion.proto]");
  process.exit(2);
}
main(address, proto).catch((error) => {
  console.error(error.message);
  process.exit(1);
});
