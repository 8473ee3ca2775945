'use strict';
// A host on the bus of emulated drives, made of the npm package `canopen` alone: its EDS reader, SDO client, NMT,
// heartbeat and EMCY consumers, SYNC producer and PDOs. Frames are lines `id#data` on standard input and output; the
// last line is a JSON object with what the host has seen.
//
// node host.js EDS

// Its checksum, of block transfers only, is a native module that would have to be built; nothing here transfers blocks.
const Module = require('module');
const load = Module._load;
Module._load = (name, ...rest) =>
    name === 'node-crc' ? { crc() { throw new Error('no block transfers here'); } } : load(name, ...rest);

const readline = require('readline');
const { Device, Eds, DataType, NmtState } = require('canopen');

const NODE = 1;
const TIMEOUT = 10000; // ms
const { UNSIGNED8, UNSIGNED16, UNSIGNED32, INTEGER8, INTEGER16, INTEGER32, VISIBLE_STRING } = DataType;

const host = new Device({ id: 126 });
const heard = { heartbeats: [], emergencies: [], positions: [], torques: [] };
const waiting = [];

function seen(list, value) {
    heard[list].push(value);
    for (const wait of waiting.splice(0)) wait();
}

// Until something that was heard makes the condition true.
async function until(what, condition) {
    const end = Date.now() + TIMEOUT;
    while (!condition()) {
        if (Date.now() > end) throw new Error(`in vain: ${what}; heard ${JSON.stringify(heard)}`);
        await new Promise((resolve) => { waiting.push(resolve); setTimeout(resolve, 20); });
    }
}

const read = (index, subIndex, dataType) =>
    host.sdo.upload({ serverId: NODE, index, subIndex, dataType, timeout: TIMEOUT });
const write = (index, subIndex, dataType, data) =>
    host.sdo.download({ serverId: NODE, index, subIndex, dataType, data, timeout: TIMEOUT });

async function refused(promise) {
    try {
        await promise;
    }
    catch (error) {
        return error.code;
    }
    return null;
}

async function map(parameter, cobId, type, entries) {
    await write(parameter, 1, UNSIGNED32, (cobId | 0x80000000) >>> 0);
    await write(parameter, 2, UNSIGNED8, type);
    await write(parameter + 0x200, 0, UNSIGNED8, 0);
    for (const [k, entry] of entries.entries()) await write(parameter + 0x200, k + 1, UNSIGNED32, entry);
    await write(parameter + 0x200, 0, UNSIGNED8, entries.length);
    await write(parameter, 1, UNSIGNED32, cobId);
}

async function command(controlword, mask, status) {
    control.value = controlword;
    host.pdo.write(0x301);
    const end = Date.now() + TIMEOUT;
    let word;
    do {
        word = await read(0x6041, 0, UNSIGNED16);
        if (Date.now() > end) throw new Error(`after ${controlword}: ${word}`);
    } while ((word & mask) !== status);
    return word;
}

let control, mode, torque, position, actual;

function configureHost() {
    const eds = host.eds;
    eds.addSdoClientParameter(NODE, 0x600 + NODE, 0x580 + NODE);
    eds.addHeartbeatConsumer(NODE, 2000);
    eds.addEmcyConsumer(0x80 + NODE);
    eds.setSyncCobId(0x80);
    eds.setSyncGenerationEnable(true);
    control = eds.addEntry(0x2000, { parameterName: 'control word', dataType: UNSIGNED16 });
    mode = eds.addEntry(0x2001, { parameterName: 'mode', dataType: INTEGER8 });
    torque = eds.addEntry(0x2002, { parameterName: 'torque', dataType: INTEGER16 });
    position = eds.addEntry(0x2003, { parameterName: 'position', dataType: INTEGER32 });
    actual = eds.addEntry(0x2004, { parameterName: 'actual torque', dataType: INTEGER16 });
    eds.addTransmitPdo({ cobId: 0x301, transmissionType: 255, dataObjects: [control, mode] });
    eds.addTransmitPdo({ cobId: 0x201, transmissionType: 255, dataObjects: [torque] });
    eds.addReceivePdo({ cobId: 0x181, transmissionType: 255, dataObjects: [position, actual] });
    host.nmt.on('heartbeat', ({ deviceId, state }) => seen('heartbeats', [deviceId, state]));
    host.emcy.on('emergency', ({ cobId, em }) => seen('emergencies', [cobId, em.code, em.register]));
}

async function main() {
    const found = {};
    const sheet = Eds.fromFile(process.argv[2]);
    found.sheet = {
        product: sheet.productName,
        dummies: sheet.dummyUsage,
        maxTorque: sheet.getEntry(0x6072).dataType === UNSIGNED16,
        vendor: sheet.getSubEntry(0x1018, 1).value,
    };

    await until('a boot-up message', () => heard.heartbeats.some(([, state]) => state === NmtState.INITIALIZING));
    found.identity = [];
    for (const sub of [1, 2, 3, 4]) found.identity.push(await read(0x1018, sub, UNSIGNED32));
    found.type = await read(0x1000, 0, UNSIGNED32);
    found.name = await read(0x1008, 0, VISIBLE_STRING); // longer than four bytes: segments
    found.status = await read(0x6041, 0, UNSIGNED16);
    await write(0x6072, 0, UNSIGNED16, 5000);
    found.written = await read(0x6072, 0, UNSIGNED16);
    found.refused = [
        await refused(read(0x2345, 0, UNSIGNED8)),
        await refused(read(0x1018, 9, UNSIGNED8)),
        await refused(write(0x6041, 0, UNSIGNED16, 0)),
        await refused(write(0x6072, 0, UNSIGNED32, 0)),
    ];

    await map(0x1400, 0x201, 1, [0x60710010]);
    await map(0x1401, 0x301, 255, [0x60400010, 0x60600008]);
    await map(0x1800, 0x181, 1, [0x60640020, 0x60770010]);
    await write(0x1801, 1, UNSIGNED32, 0xC0000281);
    await write(0x1017, 0, UNSIGNED16, 50);
    await until('pre-operational', () => heard.heartbeats.some(([, state]) => state === NmtState.PRE_OPERATIONAL));
    host.nmt.startNode(NODE);
    await until('operational', () => heard.heartbeats.some(([, state]) => state === NmtState.OPERATIONAL));

    mode.value = 10;
    await command(0x0006, 0x6F, 0x21);
    await command(0x0007, 0x6F, 0x23);
    await command(0x000F, 0x6F, 0x27);
    found.mode = await read(0x6061, 0, INTEGER8);
    found.position = await read(0x6064, 0, INTEGER32);
    torque.value = -321;
    host.pdo.write(0x201);
    for (let cycle = 1; cycle <= 3; cycle++) {
        host.sync.write();
        await until(`position ${cycle}`, () => heard.positions.length === cycle);
    }
    found.quickStop = (await command(0x0002, 0x4F, 0x40)) & 0x4F;

    // A heartbeat that is awaited and does not come: emergency 8130h, and a fault where 6007h asks for one.
    await write(0x6007, 0, INTEGER16, 1);
    await write(0x1016, 1, UNSIGNED32, (126 << 16) | 100);
    host.emit('message', { id: 0x77E, data: Buffer.from([5]), len: 1 });
    await until('emergency 8130h', () => heard.emergencies.some(([, code]) => code === 0x8130));
    found.fault = (await read(0x6041, 0, UNSIGNED16)) & 0x4F;
    found.history = await read(0x1003, 1, UNSIGNED32);
    found.heard = heard;
    return found;
}

host.on('message', ({ id, data }) => console.log(`${id.toString(16)}#${(data || Buffer.alloc(0)).toString('hex')}`));
readline.createInterface({ input: process.stdin }).on('line', (line) => {
    const [id, hex] = line.split('#');
    const data = Buffer.from(hex, 'hex');
    host.receive({ id: parseInt(id, 16), data, len: data.length });
    if (id === '181') { // the stack tells of a PDO only when a value is another one than before
        heard.torques.push(actual.value);
        seen('positions', position.value);
    }
});
configureHost();
host.start();
host.nmt.setState(NmtState.OPERATIONAL); // this host's own; nobody on the bus is told
console.log('ready');
main().then(
    (found) => { console.log(JSON.stringify(found)); process.exit(0); },
    (error) => { console.log(JSON.stringify({ error: `${error.stack}` })); process.exit(1); });
