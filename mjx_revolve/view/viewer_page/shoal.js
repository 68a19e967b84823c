// Many robots: each is one mesh that its material bends, from qpos and the tree of its bodies.

const FADE = 0.8; // s of real time that a robot takes to appear or to vanish

// A body's geometry, once for all robots that look alike.
class Body {
  constructor(data, shapes) {
    this.length = data.length;
    this.tree = data.tree.map(([parent, ...x]) => ({
      parent, place: x.slice(0, 3), turn: [x[4], x[5], x[6], x[3]], axis: x.slice(7, 10),
    }));
    this.hinges = this.tree.length - 1;
    const matrix = new THREE.Matrix4(), place = new THREE.Vector3(), turn = new THREE.Quaternion();
    const one = new THREE.Vector3(1, 1, 1);
    const join = (pick, normals) => {
      const pieces = data.pieces.map(([body, shape, color, ...x]) => {
        matrix.compose(place.fromArray(x, 0), turn.set(x[4], x[5], x[6], x[3]), one);
        return { body, color, geometry: pick(shapes[shape]).clone().applyMatrix4(matrix) };
      });
      const count = pieces.reduce((sum, { geometry }) => sum + geometry.attributes.position.count, 0);
      const geometry = new THREE.BufferGeometry();
      const add = (name, width, fill) => {
        const values = new Float32Array(width * count);
        let at = 0;
        for (const piece of pieces) {
          const n = piece.geometry.attributes.position.count;
          fill(values.subarray(width * at, width * (at + n)), piece, n);
          at += n;
        }
        geometry.setAttribute(name, new THREE.BufferAttribute(values, width));
      };
      add("position", 3, (out, piece) => out.set(piece.geometry.attributes.position.array));
      if (normals) add("normal", 3, (out, piece) => out.set(piece.geometry.attributes.normal.array));
      add("body", 1, (out, piece) => out.fill(piece.body));
      add("tint", 3, (out, piece, n) => {
        for (let i = 0; i < 3 * n; i++) out[i] = piece.color[i % 3] / 255;
      });
      for (const piece of pieces) piece.geometry.dispose();
      return geometry;
    };
    this.geometry = join((shape) => shape.geometry, true);
    this.edges = join((shape) => shape.edges, false);
    this.defines = { BODIES: 16 * Math.ceil(this.tree.length / 16) };
  }

  dispose() {
    this.geometry.dispose();
    this.edges.dispose();
  }
}

// v turned by the quaternion [x, y, z, w] at i of q.
function turnedBy(q, i, v, out) {
  const [x, y, z] = v, a = q[i], b = q[i + 1], c = q[i + 2], w = q[i + 3];
  const tx = 2 * (b * z - c * y), ty = 2 * (c * x - a * z), tz = 2 * (a * y - b * x);
  out[0] = x + w * tx + b * tz - c * ty;
  out[1] = y + w * ty + c * tx - a * tz;
  out[2] = z + w * tz + a * ty - b * tx;
  return out;
}

function product(p, i, q, out, k) {
  const [a, b, c, d] = [p[i], p[i + 1], p[i + 2], p[i + 3]], [x, y, z, w] = q;
  out[k] = d * x + a * w + b * z - c * y;
  out[k + 1] = d * y - a * z + b * w + c * x;
  out[k + 2] = d * z + a * y - b * x + c * w;
  out[k + 3] = d * w - a * x - b * y - c * z;
}

// A robot in the picture.
class Swimmer {
  constructor(body, name) {
    this.body = body;
    this.name = name;
    this.place = new THREE.Vector3();
    const count = body.defines.BODIES;
    this.bones = new Float32Array(8 * count);
    for (let k = 0; k < count; k++) this.bones[8 * k + 7] = 1;
    const uniforms = { uBodies: this.bones, uSeen: 1, uGlow: 0, uLine: 0 };
    const { defines } = body;
    this.light = makeMaterial(ROBOT, uniforms, { defines });
    this.dark = makeMaterial(SHADOW, uniforms, { defines });
    this.drawn = makeMaterial(ROBOT, { ...uniforms, uLine: 1 }, { defines, transparent: true, depthWrite: false });
    this.dark.fragmentShader = SHADOW.fragment;
    this.mesh = new THREE.Mesh(body.geometry, this.light);
    this.lines = new THREE.LineSegments(body.edges, this.drawn);
    this.lines.renderOrder = 1;
    this.mesh.layers.enable(1); // throws shadows
    this.group = new THREE.Group();
    this.group.add(this.mesh, this.lines);
    for (const thing of [this.mesh, this.lines]) thing.frustumCulled = false;
  }

  // How much of it is there, from 0 to 1, and whether it is pointed at.
  show(seen, glow) {
    for (const material of [this.light, this.drawn]) {
      material.uniforms.uSeen.value = seen;
      material.uniforms.uGlow.value = glow;
    }
    this.group.visible = seen > 0;
  }

  // qpos in MuJoCo's order, from a place in an array on.
  pose(q, from = 0) {
    const { tree } = this.body, p = this.bones, v = [0, 0, 0], turn = [0, 0, 0, 1];
    for (let k = 0; k < tree.length; k++) {
      const { parent, place, turn: rest, axis } = tree[k], at = 8 * k;
      if (parent < 0) {
        const [w, x, y, z] = [q[from + 3], q[from + 4], q[from + 5], q[from + 6]];
        const size = Math.hypot(w, x, y, z) || 1;
        for (let i = 0; i < 3; i++) p[at + i] = q[from + i];
        p[at + 4] = x / size;
        p[at + 5] = y / size;
        p[at + 6] = z / size;
        p[at + 7] = w / size;
        continue;
      }
      const up = 8 * parent, half = q[from + 6 + k] / 2, s = Math.sin(half);
      turnedBy(p, up + 4, place, v);
      for (let i = 0; i < 3; i++) p[at + i] = p[up + i] + v[i];
      product(rest, 0, [s * axis[0], s * axis[1], s * axis[2], Math.cos(half)], turn, 0);
      product(p, up + 4, turn, p, at + 4);
    }
    this.place.set(p[0], p[1], p[2]);
  }

  dispose() {
    for (const material of [this.light, this.dark, this.drawn]) material.dispose();
  }
}

// Between two poses, from i and j on: straight but for the turn, which is the shorter one.
function mixPoses(a, i, b, j, share, width, out) {
  let dot = 0;
  for (let k = 3; k < 7; k++) dot += a[i + k] * b[j + k];
  for (let k = 0; k < width; k++) {
    const sign = dot < 0 && k > 2 && k < 7 ? -1 : 1;
    out[k] = a[i + k] * (1 - share) + sign * b[j + k] * share;
  }
  return out;
}

// A colour for each robot, as far as possible from those before it.
function chipOf(number) {
  return `hsl(${Math.round((number * 137.508 + 18) % 360)} 78% 66%)`;
}

// Robots that are in the picture, by key; bodies are numbered as in the page's data.
class Shoal {
  constructor(stage, shapes) {
    this.stage = stage;
    this.packed = shapes; // by number
    this.shapes = {};
    this.bodies = {};
    this.there = new Map();
    this.pointed = null;
  }

  bodyOf(number, data) {
    if (!this.bodies[number]) {
      for (const [, shape] of data.pieces) this.shapes[shape] ??= makeShape(this.packed[shape]);
      this.bodies[number] = new Body(data, this.shapes);
    }
    return this.bodies[number];
  }

  add(key, body, name, color) {
    const swimmer = Object.assign(new Swimmer(body, name), { key, color, seen: 0, leaving: false });
    this.there.set(key, swimmer);
    this.stage.scene.add(swimmer.group);
    return swimmer;
  }

  remove(key) {
    const swimmer = this.there.get(key);
    if (!swimmer) return;
    this.stage.scene.remove(swimmer.group);
    swimmer.dispose();
    this.there.delete(key);
  }

  // Bodies that nobody has now go where there are too many to keep.
  tidy(most) {
    const used = new Set([...this.there.values()].map((swimmer) => swimmer.body));
    const idle = Object.keys(this.bodies).filter((number) => !used.has(this.bodies[number]));
    for (const number of idle.slice(0, Math.max(0, idle.length - most))) {
      this.bodies[number].dispose();
      delete this.bodies[number];
    }
  }

  // Fades, shadows and glow; `followed` is a key.
  settle(passed, followed) {
    for (const swimmer of [...this.there.values()]) {
      swimmer.seen = Math.min(1, Math.max(0, swimmer.seen + ((swimmer.leaving ? -1 : 1) * passed) / FADE));
      if (swimmer.leaving && swimmer.seen === 0) this.remove(swimmer.key);
      else swimmer.show(swimmer.seen, this.pointed === swimmer.key ? 1 : followed === swimmer.key ? 0.35 : 0);
    }
    this.stage.bent = [...this.there.values()];
  }

  // Whom a place on the screen is over: the nearest, or null.
  pick(x, y) {
    let best = null, nearest = Infinity;
    for (const swimmer of this.there.values()) {
      const at = this.onScreen(swimmer.place);
      if (!at || swimmer.leaving) continue;
      const reach = Math.max(16, 0.5 * swimmer.body.length * at.pixels), far = Math.hypot(at.x - x, at.y - y);
      if (far < reach && far / reach < nearest) [best, nearest] = [swimmer.key, far / reach];
    }
    return best;
  }

  // Where a place is on the screen [pixels], and how many of them a metre has there.
  onScreen(place) {
    const { camera, renderer } = this.stage, { clientWidth: w, clientHeight: h } = renderer.domElement;
    const p = place.clone().applyMatrix4(camera.matrixWorldInverse);
    if (p.z > -camera.near) return null;
    const pixels = h / (2 * -p.z * Math.tan((camera.fov * Math.PI) / 360));
    p.applyMatrix4(camera.projectionMatrix);
    return { x: (p.x + 1) * 0.5 * w, y: (1 - p.y) * 0.5 * h, pixels };
  }
}

// Calls back when something is clicked, rather than dragged: (x, y, event).
function onClick(element, act) {
  let down = null;
  element.addEventListener("pointerdown", (event) => (down = event.isPrimary && event.button === 0 ? [event.clientX, event.clientY] : null));
  element.addEventListener("pointerup", (event) => {
    if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 5) act(event.clientX, event.clientY, event);
    down = null;
  });
}

// Where a ray through a place on the screen meets a level plane; null above the horizon.
function onPlane(stage, x, y, height, most = 60) {
  const { camera, renderer } = stage, { clientWidth: w, clientHeight: h } = renderer.domElement;
  const ray = new THREE.Vector3((2 * x) / w - 1, 1 - (2 * y) / h, 0.5).unproject(camera).sub(camera.position).normalize();
  const far = (height - camera.position.z) / ray.z;
  if (!(far > 0) || far > most) return null;
  return camera.position.clone().addScaledVector(ray, far);
}

// Names and rings over the picture, and a map of who is where.
class Chart {
  constructor(stage, shoal) {
    this.stage = stage;
    this.shoal = shoal;
    this.named = false;
    this.map = null; // how the map was last drawn: x, y of its middle [m], pixels per metre
  }

  over(followed, marks = []) {
    const { context: c, w, h } = this.stage.pen("marks");
    c.textAlign = "center";
    c.lineWidth = 1.5;
    for (const mark of marks) this.ring(c, mark);
    for (const swimmer of this.shoal.there.values()) {
      const told = this.named || swimmer.key === followed || swimmer.key === this.shoal.pointed;
      const at = this.shoal.onScreen(swimmer.place);
      if (!at || at.x < 0 || at.y < 0 || at.x > w || at.y > h) continue;
      const small = 1 - (swimmer.body.length * at.pixels) / 24; // too far away to be made out: a dot
      if (small > 0) {
        c.globalAlpha = swimmer.seen * Math.min(1, 2 * small);
        c.fillStyle = swimmer.color;
        c.beginPath();
        c.arc(at.x, at.y, 3, 0, 2 * Math.PI);
        c.fill();
        c.globalAlpha = 1;
      }
      if (!told || swimmer.leaving) continue;
      const reach = Math.min(Math.max(0.62 * swimmer.body.length * at.pixels, 9), 0.42 * h);
      const top = Math.max(at.y - Math.max(0.45 * reach, 9), 14);
      c.font = swimmer.key === followed ? "600 13px system-ui, sans-serif" : "12px system-ui, sans-serif";
      c.globalAlpha = swimmer.seen;
      c.lineJoin = "round";
      c.strokeStyle = "rgba(2, 20, 32, 0.75)";
      c.lineWidth = 3;
      c.strokeText(swimmer.name, at.x, top);
      c.fillStyle = swimmer.color;
      c.fillText(swimmer.name, at.x, top);
      c.globalAlpha = 1;
    }
  }

  ring(c, mark) {
    const place = new THREE.Vector3(), [x, y, z] = mark.place;
    let last = null;
    c.strokeStyle = mark.color ?? "rgba(255, 170, 210, 0.8)";
    c.lineWidth = 1.5;
    c.beginPath();
    for (let k = 0; k <= 72; k++) {
      const a = (2 * Math.PI * k) / 72;
      const at = this.shoal.onScreen(place.set(x + mark.radius * Math.cos(a), y + mark.radius * Math.sin(a), z));
      if (at && last) c.lineTo(at.x, at.y);
      else if (at) c.moveTo(at.x, at.y);
      last = at;
    }
    c.stroke();
    const at = mark.name && this.shoal.onScreen(place.set(x, y, z));
    if (at) {
      c.font = "12px system-ui, sans-serif";
      c.fillStyle = c.strokeStyle;
      c.fillText(mark.name, at.x, at.y);
    }
  }

  // From above, north (y) up; reach: what must be seen, [x, y] lowest and highest [m].
  drawMap(low, high, followed, extra = () => {}) {
    const { context: c, w, h } = this.stage.pen("map"), pad = 12;
    if (w <= 2 * pad || h <= 2 * pad) return; // there is no room for it
    const span = Math.max(high[0] - low[0], high[1] - low[1], 2);
    const scale = (Math.min(w, h) - 2 * pad) / span, mx = (low[0] + high[0]) / 2, my = (low[1] + high[1]) / 2;
    const x = (a) => w / 2 + (a - mx) * scale, y = (b) => h / 2 - (b - my) * scale;
    this.map = { mx, my, scale };
    const step = roundNumber(span / 3);
    c.strokeStyle = "rgba(200, 240, 250, 0.12)";
    c.lineWidth = 1;
    c.beginPath();
    for (let a = Math.ceil((mx - w / 2 / scale) / step) * step; x(a) < w; a += step) c.moveTo(x(a), 0), c.lineTo(x(a), h);
    for (let b = Math.ceil((my - h / 2 / scale) / step) * step; y(b) > 0; b += step) c.moveTo(0, y(b)), c.lineTo(w, y(b));
    c.stroke();
    extra(c, x, y, scale);
    // The camera: what it looks at, and from where.
    const { camera, target } = this.stage, ex = x(camera.position.x), ey = y(camera.position.y);
    const angle = Math.atan2(y(target.y) - ey, x(target.x) - ex), wide = 0.42;
    c.fillStyle = "rgba(235, 250, 252, 0.10)";
    c.beginPath();
    c.moveTo(ex, ey);
    c.arc(ex, ey, 1.6 * Math.max(Math.hypot(x(target.x) - ex, y(target.y) - ey), 14), angle - wide, angle + wide);
    c.fill();
    for (const swimmer of this.shoal.there.values()) {
      const mine = swimmer.key === followed;
      c.globalAlpha = swimmer.seen;
      c.fillStyle = swimmer.color;
      c.beginPath();
      c.arc(x(swimmer.place.x), y(swimmer.place.y), mine ? 4.5 : 3, 0, 2 * Math.PI);
      c.fill();
      if (mine) {
        c.strokeStyle = "#fff";
        c.stroke();
      }
    }
    c.globalAlpha = 1;
    c.fillStyle = "rgba(226, 244, 247, 0.72)";
    c.textAlign = "right";
    c.textBaseline = "bottom";
    c.font = "10.5px system-ui, sans-serif";
    c.fillRect(w - 6 - step * scale, h - 5, step * scale, 1.5);
    c.fillText(`${step} m`, w - 6, h - 7);
  }

  // Whom, or which place [x, y] in the world, a click on the map means.
  onMap(event) {
    const box = event.currentTarget.getBoundingClientRect(), { mx, my, scale } = this.map;
    const x = mx + (event.clientX - box.left - box.width / 2) / scale;
    const y = my - (event.clientY - box.top - box.height / 2) / scale;
    let best = null, nearest = 9 / scale;
    for (const { key, place } of this.shoal.there.values()) {
      const far = Math.hypot(place.x - x, place.y - y);
      if (far < nearest) [best, nearest] = [key, far];
    }
    return { key: best, place: [x, y] };
  }
}

// Shadows reach as far, and the water is as clear, as what is looked at is far away.
function widen(stage, size, grid) {
  const far = stage.camera.position.distanceTo(stage.target);
  stage.shadow.reach = Math.min(Math.max(0.85 * size, 0.5 * far), 12 * size);
  shared.uHaze.value = Math.min(1, Math.max(4, 9 * size) / far);
  grid.material.uniforms.uReach.value = Math.max(24 * size, 1.1 * far);
}
