// What is in the picture around robots: each `make...` returns an object with the things to draw and,
// where they move, `update`.

// --------------------------------------------------------------------- data of the page

const bytesOf = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;

// {f32: base64}, {i16: base64, scale} or {values} as Float32Array.
function numbersOf(packed) {
  if (packed.values !== undefined) return new Float32Array(packed.values);
  if (packed.f32 !== undefined) return new Float32Array(bytesOf(packed.f32));
  return Float32Array.from(new Int16Array(bytesOf(packed.i16)), (x) => x * packed.scale);
}

// How many of sorted numbers are at most x.
function countUpTo(sorted, x) {
  let low = 0, high = sorted.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (sorted[middle] <= x) low = middle + 1;
    else high = middle;
  }
  return low;
}

// A quantity along time, [S, n], between its rows.
class Track {
  constructor(packed, width, step) {
    this.values = numbersOf(packed);
    this.width = width;
    this.step = step;
    this.count = this.values.length / width;
  }

  at(time, k, size, out) {
    const x = Math.min(Math.max(time / this.step, 0), this.count - 1);
    const row = Math.min(Math.floor(x), Math.max(this.count - 2, 0)), share = x - row;
    const a = row * this.width + k, b = Math.min(row + 1, this.count - 1) * this.width + k;
    for (let i = 0; i < size; i++) out[i] = this.values[a + i] * (1 - share) + this.values[b + i] * share;
    return out;
  }

  vector(time, k, out) {
    return out.fromArray(this.at(time, 3 * k, 3, [0, 0, 0]));
  }
}

// --------------------------------------------------------------------- materials and meshes

const shared = {
  uTime: { value: 0 },
  uEye: { value: new THREE.Vector3() },
  uSurface: { value: 0 },
  uSun: { value: new THREE.Vector3(...PALETTE.sun) },
  uSize: { value: 1 },
  uHaze: { value: 1 },
  uWaves: { value: [] },
  uFade: { value: [] },
  uShadow: { value: null },
  uShadowMatrix: { value: new THREE.Matrix4() },
  uTarget: { value: new THREE.Vector3() },
};
let maxWaves = 1;

// Uniforms by their values; `more` are those that materials share.
function makeMaterial(shader, uniforms = {}, options = {}, more = {}) {
  const all = { ...shared, ...more };
  for (const name in uniforms) all[name] = { value: uniforms[name] };
  const { defines, ...rest } = options;
  return new THREE.ShaderMaterial({
    defines: { MAX_WAVES: maxWaves, ...defines },
    uniforms: all,
    vertexShader: UNIFORMS + shader.vertex,
    fragmentShader: UNIFORMS + LIGHT + shader.fragment,
    ...rest,
  });
}

// Attributes by name: arrays of numbers and how many of them a vertex has.
function makeGeometry(attributes, index = null) {
  const geometry = new THREE.BufferGeometry();
  for (const name in attributes) {
    const [values, width] = attributes[name];
    geometry.setAttribute(name, new THREE.BufferAttribute(Float32Array.from(values), width));
  }
  if (index) geometry.setIndex(Array.from(index));
  return geometry;
}

const FLAT = { transparent: true, depthWrite: false }, BOTH = { side: THREE.DoubleSide };

// A thing that is always drawn, after those of lower order.
function makeMesh(geometry, material, order = 0, Kind = THREE.Mesh, ...more) {
  const mesh = new Kind(geometry, material, ...more);
  mesh.frustumCulled = false;
  mesh.renderOrder = order;
  return mesh;
}

// Triangles of a robot's piece, and lines along their edges.
function makeShape({ vertices, normals, faces }) {
  const attributes = { position: [numbersOf(vertices), 3], normal: [numbersOf(normals), 3] };
  const geometry = makeGeometry(attributes, numbersOf(faces)).toNonIndexed();
  return { geometry, edges: new THREE.EdgesGeometry(geometry, 32) };
}

// --------------------------------------------------------------------- around robots

function makeBackground() {
  const uUnproject = new THREE.Matrix4();
  const material = makeMaterial(BACKGROUND, { uUnproject }, { depthTest: false, depthWrite: false });
  return {
    mesh: makeMesh(new THREE.PlaneGeometry(2, 2), material, -10),
    update: (camera) => uUnproject.multiplyMatrices(camera.matrixWorld, camera.projectionMatrixInverse),
  };
}

// Level rings of these radii around a place; `rise` is their height.
function makeRings(radius, sectors, [x, y] = [0, 0], rise = () => 0) {
  const position = [], spacing = [], index = [];
  radius.forEach((r, i) => {
    for (let j = 0; j < sectors; j++) {
      const angle = (2 * Math.PI * j) / sectors, k = i * sectors + j, next = i * sectors + ((j + 1) % sectors);
      position.push(x + r * Math.cos(angle), y + r * Math.sin(angle), rise(k));
      spacing.push(r - (radius[i - 1] ?? 0));
      if (i + 1 < radius.length) index.push(k, k + sectors, next + sectors, k, next + sectors, next);
    }
  });
  return makeGeometry({ position: [position, 3], spacing: [spacing, 1] }, index);
}

// Fine below the eye, and out to the horizon.
function makeSurface(size) {
  const material = makeMaterial(SURFACE, { uCenter: new THREE.Vector2() }, { ...FLAT, ...BOTH });
  const radius = Array.from({ length: 120 }, (_, i) => (i && 0.1 * size * (9000 / size) ** ((i - 1) / 118)));
  const mesh = makeMesh(makeRings(radius, 144), material);
  return {
    mesh,
    update(target, eye) {
      material.uniforms.uCenter.value.set(target.x, target.y);
      // From above the water lies over what is in it, from below it lies behind.
      mesh.renderOrder = eye.z > shared.uSurface.value ? 8 : 2;
    },
  };
}

function makeBed({ center, radius, height, sectors }) {
  const geometry = makeRings(radius, sectors, center, (k) => height[k]);
  geometry.computeVertexNormals();
  return makeMesh(geometry, makeMaterial(BED, {}, BOTH));
}

function makeGrid(height, size, step, shade) {
  const uniforms = { uHeight: height, uReach: 6 * size, uStep: step, uShade: shade ? 1 : 0 };
  return makeMesh(new THREE.PlaneGeometry(2, 2), makeMaterial(GRID, uniforms, { ...FLAT, ...BOTH }), 3);
}

function makeDust(size) {
  let seed = 1;
  const draw = () => (seed = (seed * 16807) % 2147483647) / 2147483647; // the same dust every time
  const position = Array.from({ length: 3300 }, draw), weight = Array.from({ length: 1100 }, () => draw() ** 3);
  const material = makeMaterial(DUST, { uDrift: new THREE.Vector3(), uBox: 7 * size, uPixels: 1 }, FLAT);
  const geometry = makeGeometry({ position: [position, 3], weight: [weight, 1] });
  return { points: makeMesh(geometry, material, 5, THREE.Points), material };
}

// --------------------------------------------------------------------- forces, current, target

// Frees what a group keeps on the graphics card.
function release(group) {
  group.traverse((thing) => (thing.geometry?.dispose(), thing.material?.dispose(), thing.dispose?.()));
}

// Copies of a geometry, drawn twice: as they are, and faintly through what hides them.
function makeCopies(geometry, color, count, group) {
  const Kind = THREE.InstancedMesh, uniforms = { uColor: new THREE.Vector3(...color), uThick: 0 };
  const clear = makeMaterial(ARROW, { ...uniforms, uAlpha: 0.35 }, { ...FLAT, depthTest: false });
  const solid = makeMesh(geometry, makeMaterial(ARROW, { ...uniforms, uAlpha: 1 }), 0, Kind, count);
  const ghost = makeMesh(geometry, clear, 6, Kind, count);
  ghost.instanceMatrix = solid.instanceMatrix;
  group.add(solid, ghost);
  return solid;
}

const UPWARDS = new THREE.Vector3(0, 1, 0), turning = new THREE.Quaternion(), stretching = new THREE.Vector3();

// Puts a copy of what stands on the origin, along y, at a place along a unit vector.
function lay(mesh, k, place, along, thick, length) {
  turning.setFromUnitVectors(UPWARDS, along);
  mesh.setMatrixAt(k, new THREE.Matrix4().compose(place, turning, stretching.set(thick, length, thick)));
}

// A trail through points [n, 3], `step` seconds apart: its past, and all of it more faintly. It is cut
// where a point is farther than `leap` from the one before.
function makeTrail(points, step, leap = Infinity) {
  const count = points.length / 3 - 1, group = new THREE.Group(), a = new THREE.Vector3(), b = new THREE.Vector3();
  const bar = new THREE.CylinderGeometry(1, 1, 1, 6, 1, true).translate(0, 0.5, 0);
  const [past, all] = [[PALETTE.accent.map((x, i) => x * (1 - 0.2 * i)), 1], [PALETTE.dust, 0.22]].map(([color, uAlpha]) => {
    const uniforms = { uColor: new THREE.Vector3(...color), uThick: 0.0028, uAlpha };
    return makeMesh(bar, makeMaterial(ARROW, uniforms, uAlpha < 1 ? FLAT : {}), 4, THREE.InstancedMesh, count);
  });
  all.instanceMatrix = past.instanceMatrix;
  for (let k = 0; k < count; k++) {
    a.fromArray(points, 3 * k);
    const length = b.fromArray(points, 3 * k + 3).sub(a).length(), shown = length > 1e-9 && length < leap ? 1 : 0;
    lay(past, k, a, shown ? b.normalize() : UPWARDS, shown, shown * length);
  }
  group.add(past, all);
  return { group, show: (time) => (past.count = Math.min(Math.max(Math.ceil(time / step), 0), count)) };
}

// Arrows of one kind of force, one for each anchor on a robot; `scale` is metres per newton.
function makeArrows(kind, anchors, robot, step, size) {
  const count = anchors.length, track = new Track(kind.force, 3 * count, step), group = new THREE.Group();
  const shafts = makeCopies(new THREE.CylinderGeometry(1, 1, 1, 12, 1).translate(0, 0.5, 0), kind.color, count, group);
  const heads = makeCopies(new THREE.ConeGeometry(1, 1, 20).translate(0, 0.5, 0), kind.color, count, group);
  group.visible = false;
  const from = new THREE.Vector3(), force = new THREE.Vector3(), along = new THREE.Vector3();
  const thick = 0.0085 * size, wide = 0.024 * size, tip = 0.055 * size;
  return {
    group,
    scale: kind.scale,
    update(time) {
      anchors.forEach(({ body, place }, k) => {
        track.vector(time, k, force);
        const length = force.length() * this.scale;
        // Arrows that are shorter than their heads shrink, and very short ones are left out.
        const small = length < 0.004 * size ? 0 : Math.min(1, length / (1.6 * tip)), head = tip * small;
        robot.point(body, place, from);
        lay(shafts, k, from, along.copy(force).normalize(), thick * small, length - head);
        lay(heads, k, from.addScaledVector(along, length - head), along, wide * small, head);
      });
      shafts.instanceMatrix.needsUpdate = heads.instanceMatrix.needsUpdate = true;
    },
  };
}

// An arrow above what is looked at, along the water's velocity; `scale` is metres per metre a second.
function makeCurrent(velocity, scale, step, size) {
  const tail = new THREE.Vector3(), now = new THREE.Vector3(), track = new Track(velocity, 3, step);
  const above = { point: (body, place, out) => out.copy(tail) };
  const kind = { force: velocity, color: PALETTE.current, scale };
  const arrow = makeArrows(kind, [{}], above, step, size);
  return {
    group: arrow.group,
    speed: (time) => track.vector(time, 0, now).length(),
    update(time, center) {
      tail.copy(center).addScaledVector(track.vector(time, 0, now), -0.5 * scale); // its middle is above
      tail.z += 0.3 * size;
      arrow.update(time);
    },
  };
}

// A diamond where the robot is to go.
function makeTarget(size) {
  const group = new THREE.Group(), matrix = new THREE.Matrix4().makeScale(0.12 * size, 0.12 * size, 0.12 * size);
  const diamond = makeRings([0, 0.6, 0], 24, [0, 0], (k) => 1 - Math.floor(k / 24));
  diamond.computeVertexNormals();
  const mesh = makeCopies(diamond, PALETTE.target, 1, group);
  return {
    group,
    update(place) {
      mesh.setMatrixAt(0, matrix.setPosition(place));
      mesh.instanceMatrix.needsUpdate = true;
    },
  };
}

// --------------------------------------------------------------------- the robot's shadow

function makeShadow(size) {
  const nearest = { minFilter: THREE.NearestFilter, magFilter: THREE.NearestFilter };
  const target = new THREE.WebGLRenderTarget(1024, 1024, nearest);
  const camera = new THREE.OrthographicCamera(-1, 1, 1, -1, 0, 1);
  camera.layers.set(1);
  shared.uShadow.value = target.texture;
  return {
    reach: 0.85 * size, // around what is looked at [m]
    // Meshes of robots bring a material for their shadows along.
    render(renderer, scene, around, meshes) {
      const far = Math.max(3 * size, 1.5 * this.reach);
      camera.left = camera.bottom = -this.reach;
      camera.right = camera.top = this.reach;
      camera.far = 2 * far;
      camera.updateProjectionMatrix();
      camera.position.copy(around).addScaledVector(shared.uSun.value, far);
      camera.up.set(0, 1, 0);
      camera.lookAt(around);
      camera.updateMatrixWorld(true);
      shared.uShadowMatrix.value.multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
      // A texture cannot be read while it is drawn.
      shared.uShadow.value = null;
      for (const { mesh, dark } of meshes) mesh.material = dark;
      renderer.setRenderTarget(target);
      renderer.setClearColor(0xffffff, 1);
      renderer.clear();
      renderer.render(scene, camera);
      renderer.setRenderTarget(null);
      for (const { mesh, light } of meshes) mesh.material = light;
      shared.uShadow.value = target.texture;
    },
  };
}
