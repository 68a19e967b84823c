// Robots: each is one mesh that its material bends, from qpos and the tree of its bodies; names over
// the picture, and the map.

const FADE = 0.8; // s of real time that a robot takes to appear or to vanish
const CHUNK = 96; // bodies of one mesh: uniforms of a vertex shader, two for each body

// The poses of a robot: rising times and a row of qpos for each.
class Poses {
  constructor(times = [], rows = [], leap = Infinity) {
    Object.assign(this, { times, rows, leap, pose: [] });
  }

  // Whether the robot was put elsewhere after a row, as beyond the edge of an arena.
  leaps(i) {
    const a = this.rows[i], b = this.rows[i + 1];
    return Math.hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2]) > this.leap;
  }

  // Between rows places go along a curve, as swimming robots do, and all else straight; a turn is the shorter one.
  at(time) {
    const { times: t, rows, pose } = this, i = Math.max(countUpTo(t, time) - 1, 0), a = rows[i];
    const last = i + 1 >= t.length || time <= t[i] || this.leaps(i), b = last ? a : rows[i + 1];
    const span = t[i + 1] - t[i], s = last ? 0 : (time - t[i]) / span, s2 = s * s, s3 = s2 * s;
    const dot = a[3] * b[3] + a[4] * b[4] + a[5] * b[5] + a[6] * b[6];
    for (let k = 0; k < a.length; k++) pose[k] = a[k] * (1 - s) + (dot < 0 && k > 2 && k < 7 ? -s : s) * b[k];
    if (last || i === 0 || i + 2 >= t.length || this.leaps(i - 1) || this.leaps(i + 1)) return pose;
    const before = span / (t[i + 1] - t[i - 1]), after = span / (t[i + 2] - t[i]);
    for (let k = 0; k < 3; k++) {
      const m = (b[k] - rows[i - 1][k]) * before, n = (rows[i + 2][k] - a[k]) * after;
      pose[k] = (2 * s3 - 3 * s2 + 1) * a[k] + (s3 - 2 * s2 + s) * m + (3 * s2 - 2 * s3) * b[k] + (s3 - s2) * n;
    }
    return pose;
  }

  // Net, over ground, between two times as far as they are known [m/s]; NaN where that is not known.
  speed(from, to) {
    const t = this.times, a = Math.max(from, t[0]), b = Math.min(to, t[t.length - 1]);
    const [x, y, z] = this.at(a), [u, v, w] = this.at(b), way = Math.hypot(u - x, v - y, w - z);
    return b > a && way < this.leap ? way / (b - a) : NaN;
  }

  // The way as a line in the picture, at most 4000 points of it.
  trail() {
    const { times } = this, from = times[0], span = Math.max(times[times.length - 1] - from, 1e-6);
    const count = Math.min(Math.max(2, 4 * times.length), 4000), points = new Float32Array(3 * count);
    for (let k = 0; k < count; k++) points.set(this.at(from + (span * k) / (count - 1)).slice(0, 3), 3 * k);
    return { ...makeTrail(points, span / (count - 1), this.leap), from };
  }
}

// A colour for each robot, as far as possible from those before it.
function colorOf(number) {
  return `hsl(${Math.round((number * 137.508 + 18) % 360)} 78% 66%)`;
}

// The tree of a body as it is packed: parent, place, quaternion w first, hinge's axis.
function readTree(packed) {
  return packed.map(([parent, ...x]) => ({
    parent, place: new THREE.Vector3(...x), turn: new THREE.Quaternion(x[4], x[5], x[6], x[3]),
    axis: new THREE.Vector3(...x.slice(7)),
  }));
}

// Places and quaternions of all bodies, 8 numbers each, from qpos in MuJoCo's order.
function poseTree(tree, q, bones) {
  const place = new THREE.Vector3(), turn = new THREE.Quaternion(), up = new THREE.Quaternion();
  const base = new THREE.Vector3(), hinge = new THREE.Quaternion();
  tree.forEach((body, k) => {
    if (body.parent < 0) {
      place.fromArray(q);
      turn.set(q[4], q[5], q[6], q[3]).normalize();
    } else {
      up.fromArray(bones, 8 * body.parent + 4);
      place.copy(body.place).applyQuaternion(up).add(base.fromArray(bones, 8 * body.parent));
      turn.multiplyQuaternions(up, body.turn).multiply(hinge.setFromAxisAngle(body.axis, q[6 + k]));
    }
    place.toArray(bones, 8 * k);
    turn.toArray(bones, 8 * k + 4);
  });
}

// A body's geometry, once for all robots that look alike, in chunks of bodies.
class Body {
  constructor(data, shapes) {
    this.length = data.length;
    this.tree = readTree(data.tree);
    const matrix = new THREE.Matrix4(), place = new THREE.Vector3(), turn = new THREE.Quaternion();
    const one = new THREE.Vector3(1, 1, 1);
    const pieces = data.pieces.map(([body, shape, color, ...x]) => {
      matrix.compose(place.fromArray(x, 0), turn.set(x[4], x[5], x[6], x[3]), one);
      const { geometry, edges } = shapes[shape];
      return { body, color, faces: geometry.clone().applyMatrix4(matrix), edges: edges.clone().applyMatrix4(matrix) };
    });
    this.chunks = [];
    for (let first = 0; first < this.tree.length; first += CHUNK) {
      const own = pieces.filter(({ body }) => body >= first && body < first + CHUNK);
      const bodies = 16 * Math.ceil(Math.min(this.tree.length - first, CHUNK) / 16);
      const [faces, edges] = ["faces", "edges"].map((kind) => joinPieces(own, kind, first));
      this.chunks.push({ first, bodies, faces, edges });
    }
  }

  dispose() {
    for (const { faces, edges } of this.chunks) faces.dispose(), edges.dispose();
  }
}

// One geometry of many pieces, each vertex with its body and colour.
function joinPieces(pieces, kind, first) {
  const joined = { body: [[], 1], tint: [[], 3] };
  for (const name of kind === "faces" ? ["position", "normal"] : ["position"]) joined[name] = [[], 3];
  for (const { body, color, [kind]: { attributes } } of pieces) {
    for (const name in attributes) if (joined[name]) for (const x of attributes[name].array) joined[name][0].push(x);
    for (let k = 0; k < attributes.position.count; k++) {
      joined.body[0].push(body - first);
      joined.tint[0].push(...color.map((x) => x / 255));
    }
  }
  return makeGeometry(joined);
}

// A robot in the picture.
class RobotMesh {
  constructor(body, facts) {
    Object.assign(this, { body, place: new THREE.Vector3(), seen: 0, leaving: false, posed: false }, facts);
    const size = body.chunks.reduce((sum, { bodies }) => sum + bodies, 0);
    this.bones = new Float32Array(8 * size);
    for (let k = 0; k < size; k++) this.bones[8 * k + 7] = 1;
    this.group = new THREE.Group();
    this.look = { uSeen: { value: 1 }, uGlow: { value: 0 } };
    this.faces = body.chunks.map(({ first, bodies, faces, edges }) => {
      const uBodies = this.bones.subarray(8 * first, 8 * (first + bodies));
      const uniforms = { uBodies, uLine: 0 }, defines = { BODIES: bodies };
      const light = makeMaterial(ROBOT, uniforms, { defines }, this.look), dark = makeMaterial(SHADOW, uniforms, { defines });
      const line = makeMaterial(ROBOT, { ...uniforms, uLine: 1 }, { defines, ...FLAT }, this.look);
      dark.fragmentShader = SHADOW.fragment;
      const mesh = makeMesh(faces, light);
      mesh.layers.enable(1); // throws shadows
      this.group.add(mesh, makeMesh(edges, line, 1, THREE.LineSegments));
      return { mesh, light, dark, line };
    });
    this.group.visible = false;
  }

  // How much of it is there, from 0 to 1, and how bright it is where it is pointed at.
  show(seen, glow) {
    this.look.uSeen.value = seen;
    this.look.uGlow.value = glow;
    this.group.visible = seen > 0 && this.posed;
  }

  pose(qpos) {
    poseTree(this.body.tree, qpos, this.bones);
    this.place.fromArray(this.bones);
    this.posed = true;
  }

  // Where a place in a body's frame is in the world.
  point(body, place, out) {
    const [x, y, z] = this.bones.subarray(8 * body), turn = new THREE.Quaternion().fromArray(this.bones, 8 * body + 4);
    return out.fromArray(place).applyQuaternion(turn).add({ x, y, z });
  }

  dispose() {
    for (const { light, dark, line } of this.faces) light.dispose(), dark.dispose(), line.dispose();
  }
}

// Robots in the picture, by key; bodies are numbered as in the page's data.
class Robots {
  constructor(stage, shapes) {
    Object.assign(this, { stage, packed: shapes, shapes: {}, bodies: {}, there: new Map(), pointed: null });
  }

  bodyOf(number, data) {
    if (!this.bodies[number]) {
      for (const [, shape] of data.pieces) this.shapes[shape] ??= makeShape(this.packed[shape]);
      this.bodies[number] = new Body(data, this.shapes);
    }
    return this.bodies[number];
  }

  add(key, body, facts) {
    const robot = new RobotMesh(body, { key, ...facts });
    this.there.set(key, robot);
    this.stage.scene.add(robot.group);
  }

  remove(key) {
    const robot = this.there.get(key);
    if (!robot) return;
    this.stage.scene.remove(robot.group);
    robot.dispose();
    this.there.delete(key);
  }

  // Drops bodies that no robot has, where there are too many to keep.
  tidy(most) {
    const used = new Set([...this.there.values()].map((robot) => robot.body));
    const idle = Object.keys(this.bodies).filter((number) => !used.has(this.bodies[number]));
    for (const number of idle.slice(0, Math.max(0, idle.length - most))) {
      this.bodies[number].dispose();
      delete this.bodies[number];
    }
  }

  get living() {
    return [...this.there.values()].filter((robot) => !robot.leaving);
  }

  // Whether a robot is appearing or vanishing.
  get fading() {
    return [...this.there.values()].some((robot) => robot.leaving || robot.seen < 1);
  }

  // Fades, shadows and glow; `followed` is a key or null.
  settle(passed, followed) {
    for (const robot of [...this.there.values()]) {
      robot.seen = Math.min(1, Math.max(0, robot.seen + ((robot.leaving ? -1 : 1) * passed) / FADE));
      if (robot.leaving && robot.seen === 0) this.remove(robot.key);
      else robot.show(robot.seen, this.pointed === robot.key ? 1 : followed === robot.key ? 0.35 : 0);
    }
    this.stage.meshes = [...this.there.values()].flatMap((robot) => robot.faces);
  }

  // Key of the robot that a place on the screen is over: the nearest, or null.
  pick(x, y) {
    let best = null, nearest = 1;
    for (const robot of this.living) {
      const at = this.stage.onScreen(robot.place);
      if (!at) continue;
      const far = Math.hypot(at.x - x, at.y - y) / Math.max(16, 0.5 * robot.body.length * at.pixels);
      if (far < nearest) [best, nearest] = [robot.key, far];
    }
    return best;
  }
}

// Names and rings over the picture, and a map from above.
class Overlay {
  constructor(stage, robots) {
    Object.assign(this, { stage, robots, named: false });
    this.map = null; // how the map was last drawn: x, y of its middle [m], pixels per metre
  }

  draw(followed, marks = []) {
    const { context: c, w, h } = this.stage.pen("marks");
    c.textAlign = "center";
    for (const mark of marks) this.ring(c, mark);
    c.lineWidth = 3;
    c.lineJoin = "round";
    for (const robot of this.robots.there.values()) {
      const at = this.stage.onScreen(robot.place);
      if (!robot.posed || !at || at.x < 0 || at.y < 0 || at.x > w || at.y > h) continue;
      const extent = robot.body.length * at.pixels, small = 1 - extent / 24; // too far away to be made out: a dot
      c.fillStyle = robot.color;
      if (small > 0) {
        c.globalAlpha = robot.seen * Math.min(1, 2 * small);
        disc(c, at.x, at.y, 3);
      }
      const named = this.named || robot.key === followed || robot.key === this.robots.pointed;
      if (named && !robot.leaving) {
        const reach = Math.min(Math.max(0.62 * extent, 9), 0.42 * h), top = Math.max(at.y - Math.max(0.45 * reach, 9), 14);
        c.font = robot.key === followed ? "600 13px system-ui, sans-serif" : "12px system-ui, sans-serif";
        c.globalAlpha = robot.seen;
        c.strokeStyle = "rgba(2, 20, 32, 0.75)";
        c.strokeText(robot.name, at.x, top);
        c.fillText(robot.name, at.x, top);
      }
      c.globalAlpha = 1;
    }
  }

  // A level ring around a place, as it is seen.
  ring(c, { place: [x, y, z], radius, name }) {
    const point = new THREE.Vector3();
    c.strokeStyle = c.fillStyle = PLACE;
    c.lineWidth = 1.5;
    c.beginPath();
    let before = null;
    for (let k = 0; k <= 72; k++) {
      const a = (2 * Math.PI * k) / 72;
      const at = this.stage.onScreen(point.set(x + radius * Math.cos(a), y + radius * Math.sin(a), z));
      if (at) c[before ? "lineTo" : "moveTo"](at.x, at.y);
      before = at;
    }
    c.stroke();
    const at = name && this.stage.onScreen(point.set(x, y, z));
    c.font = "12px system-ui, sans-serif";
    if (at) c.fillText(name, at.x, at.y);
  }

  // From above, y up; low, high: what must be seen, [x, y] [m]; extra draws below the robots.
  drawMap(low, high, followed, extra) {
    const { context: c, w, h } = this.stage.pen("map"), pad = 12;
    if (w <= 2 * pad || h <= 2 * pad) return; // there is no room for it
    const span = Math.max(high[0] - low[0], high[1] - low[1], 2);
    const scale = (Math.min(w, h) - 2 * pad) / span, mx = (low[0] + high[0]) / 2, my = (low[1] + high[1]) / 2;
    const x = (a) => w / 2 + (a - mx) * scale, y = (b) => h / 2 - (b - my) * scale;
    this.map = { mx, my, scale };
    const step = roundNumber(span / 3);
    c.fillStyle = "rgba(200, 240, 250, 0.12)";
    for (let a = Math.ceil((mx - w / 2 / scale) / step) * step; x(a) < w; a += step) c.fillRect(x(a), 0, 1, h);
    for (let b = Math.ceil((my - h / 2 / scale) / step) * step; y(b) > 0; b += step) c.fillRect(0, y(b), w, 1);
    extra(c, x, y, scale);
    // The camera: what it looks at, and from where.
    const { camera, target } = this.stage, ex = x(camera.position.x), ey = y(camera.position.y);
    const angle = Math.atan2(y(target.y) - ey, x(target.x) - ex), wide = 0.42;
    c.fillStyle = "rgba(235, 250, 252, 0.10)";
    c.beginPath();
    c.moveTo(ex, ey);
    c.arc(ex, ey, 1.6 * Math.max(Math.hypot(x(target.x) - ex, y(target.y) - ey), 14), angle - wide, angle + wide);
    c.fill();
    for (const robot of this.robots.there.values()) {
      c.globalAlpha = robot.seen;
      c.fillStyle = robot.color;
      disc(c, x(robot.place.x), y(robot.place.y), robot.key === followed ? 4.5 : 3);
      c.strokeStyle = "#fff";
      if (robot.key === followed) c.stroke();
    }
    c.globalAlpha = 1;
    c.fillStyle = "rgba(226, 244, 247, 0.72)";
    c.fillRect(w - 6 - step * scale, h - 5, step * scale, 1.5);
    c.textAlign = "right";
    c.fillText(`${step} m`, w - 6, h - 9);
  }

  // The robot, and the place [x, y] in the world, that a click on the map means.
  onMap(event) {
    const box = event.currentTarget.getBoundingClientRect(), { mx, my, scale } = this.map;
    const x = mx + (event.clientX - box.left - box.width / 2) / scale;
    const y = my - (event.clientY - box.top - box.height / 2) / scale;
    const far = (robot) => Math.hypot(robot.place.x - x, robot.place.y - y);
    const near = [...this.robots.there.values()].filter((robot) => far(robot) < 9 / scale);
    return { key: near.sort((a, b) => far(a) - far(b))[0]?.key ?? null, place: [x, y] };
  }
}
