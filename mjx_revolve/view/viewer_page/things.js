// What is in the picture: each `make...` returns an object with the things to draw and `update`.

// --------------------------------------------------------------------- data from the page

function bytesOf(text) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes.buffer;
}

// {f32: base64} or {i16: base64, scale} as Float32Array.
function numbersOf(packed) {
  if (packed.f32 !== undefined) return new Float32Array(bytesOf(packed.f32));
  return Float32Array.from(new Int16Array(bytesOf(packed.i16)), (x) => x * packed.scale);
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

// --------------------------------------------------------------------- materials

const shared = {
  uTime: { value: 0 },
  uEye: { value: new THREE.Vector3() },
  uSurface: { value: 0 },
  uSun: { value: new THREE.Vector3(-0.32, -0.20, 1).normalize() },
  uSize: { value: 1 },
  uHaze: { value: 1 },
  uWaves: { value: [] },
  uFade: { value: [] },
  uShadow: { value: null },
  uShadowMatrix: { value: new THREE.Matrix4() },
  uTarget: { value: new THREE.Vector3() },
};
let maxWaves = 1;

function makeMaterial(shader, uniforms = {}, options = {}) {
  const all = { ...shared };
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

// --------------------------------------------------------------------- the robot

// Normals that are smooth over gentle bends and break at edges, for triangles [m, 3, 3].
function bentNormals(position) {
  const count = position.length / 9, flat = [], around = new Map(), keys = [];
  const a = new THREE.Vector3(), b = new THREE.Vector3(), c = new THREE.Vector3();
  for (let t = 0; t < count; t++) {
    a.fromArray(position, 9 * t);
    b.fromArray(position, 9 * t + 3).sub(a);
    c.fromArray(position, 9 * t + 6).sub(a);
    flat.push(b.cross(c).clone()); // its length is twice the area: large faces count more
    for (let v = 0; v < 3; v++) {
      const at = 9 * t + 3 * v;
      const key = [0, 1, 2].map((i) => Math.round(position[at + i] * 2e5)).join();
      keys.push(key);
      if (!around.has(key)) around.set(key, []);
      around.get(key).push(t);
    }
  }
  const unit = flat.map((n) => n.clone().normalize()), normal = new Float32Array(position.length);
  keys.forEach((key, k) => {
    const own = unit[Math.floor(k / 3)], sum = new THREE.Vector3();
    for (const t of around.get(key)) if (unit[t].dot(own) > 0.8) sum.add(flat[t]);
    sum.normalize().toArray(normal, 3 * k);
  });
  return normal;
}

// Triangles as they are drawn: with normals, and lines along their edges.
function makeShape(packed) {
  const position = numbersOf(packed), geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(position, 3));
  geometry.setAttribute("normal", new THREE.BufferAttribute(bentNormals(position), 3));
  return { geometry, edges: new THREE.EdgesGeometry(geometry, 32) };
}

function makeRobot(data, step) {
  const shapes = data.shapes.map(makeShape);
  const bodies = Array.from({ length: data.bodies }, () => new THREE.Group());
  const group = new THREE.Group();
  group.add(...bodies);
  const materials = new Map();
  const materialOf = (color, line) => {
    const key = [...color, line].join();
    if (!materials.has(key)) {
      const uniforms = { uColor: new THREE.Vector3(...color), uLine: line };
      materials.set(key, makeMaterial(ROBOT, uniforms, { transparent: line > 0, depthWrite: !line }));
    }
    return materials.get(key);
  };
  for (const piece of data.pieces) {
    const matrix = new THREE.Matrix4().fromArray(piece.matrix);
    const { geometry, edges } = shapes[piece.shape];
    const mesh = new THREE.Mesh(geometry, materialOf(piece.color, 0));
    const lines = new THREE.LineSegments(edges, materialOf(piece.color, 1));
    lines.renderOrder = 1;
    for (const thing of [mesh, lines]) {
      thing.matrixAutoUpdate = false;
      thing.matrix.copy(matrix);
      thing.frustumCulled = false;
      bodies[piece.body].add(thing);
    }
    mesh.layers.enable(1); // throws shadows
  }
  const place = new Track(data.position, 3 * data.bodies, step);
  const turn = new Track(data.quaternion, 4 * data.bodies, step);
  const q = [0, 0, 0, 0];
  return {
    group,
    bodies,
    update(time) {
      bodies.forEach((body, k) => {
        place.vector(time, k, body.position);
        turn.at(time, 4 * k, 4, q); // neighbours are close, so a straight mean turns well
        body.quaternion.set(q[1], q[2], q[3], q[0]).normalize();
      });
      group.updateMatrixWorld(true);
    },
  };
}

// --------------------------------------------------------------------- around it

function makeBackground() {
  const material = makeMaterial(
    BACKGROUND, { uUnproject: new THREE.Matrix4() }, { depthTest: false, depthWrite: false },
  );
  const mesh = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), material);
  mesh.frustumCulled = false;
  mesh.renderOrder = -10;
  return {
    mesh,
    update(camera) {
      material.uniforms.uUnproject.value
        .multiplyMatrices(camera.matrixWorld, camera.projectionMatrixInverse);
    },
  };
}

// A disc whose rings widen outwards: fine below the eye, and out to the horizon.
function makeDisc(first, last, rings, sectors) {
  const position = [0, 0, 0], spacing = [first], index = [], growth = (last / first) ** (1 / (rings - 1));
  for (let i = 0; i < rings; i++) {
    const r = first * growth ** i;
    for (let j = 0; j < sectors; j++) {
      const angle = (2 * Math.PI * (j + 0.5 * (i % 2))) / sectors;
      position.push(r * Math.cos(angle), r * Math.sin(angle), 0);
      spacing.push(r * Math.max(growth - 1, (2 * Math.PI) / sectors));
    }
  }
  const at = (i, j) => 1 + i * sectors + (j % sectors);
  for (let j = 0; j < sectors; j++) index.push(0, at(0, j), at(0, j + 1));
  for (let i = 0; i + 1 < rings; i++) {
    for (let j = 0; j < sectors; j++) {
      index.push(at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j), at(i + 1, j + 1), at(i, j + 1));
    }
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(position), 3));
  geometry.setAttribute("spacing", new THREE.BufferAttribute(new Float32Array(spacing), 1));
  geometry.setIndex(index);
  return geometry;
}

function makeSurface(size) {
  const material = makeMaterial(SURFACE, { uCenter: new THREE.Vector2() }, {
    transparent: true, depthWrite: false, side: THREE.DoubleSide,
  });
  const mesh = new THREE.Mesh(makeDisc(0.1 * size, 900, 120, 144), material);
  mesh.frustumCulled = false;
  return {
    mesh,
    update(target, eye) {
      material.uniforms.uCenter.value.set(target.x, target.y);
      // From above the water lies over what is in it, from below it lies behind.
      mesh.renderOrder = eye.z > shared.uSurface.value ? 8 : 2;
    },
  };
}

function makeBed(data) {
  const height = numbersOf(data.height), { rings, sectors } = data;
  const radius = numbersOf(data.radius), position = new Float32Array(3 * height.length), index = [];
  for (let i = 0; i < rings; i++) {
    for (let j = 0; j < sectors; j++) {
      const k = i * sectors + j, angle = (2 * Math.PI * j) / sectors;
      position[3 * k] = data.center[0] + radius[i] * Math.cos(angle);
      position[3 * k + 1] = data.center[1] + radius[i] * Math.sin(angle);
      position[3 * k + 2] = height[k];
      if (i + 1 < rings) {
        const next = i * sectors + ((j + 1) % sectors);
        index.push(k, k + sectors, next + sectors, k, next + sectors, next);
      }
    }
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(position, 3));
  geometry.setIndex(index);
  geometry.computeVertexNormals();
  const mesh = new THREE.Mesh(geometry, makeMaterial(BED, {}, { side: THREE.DoubleSide }));
  mesh.frustumCulled = false;
  return mesh;
}

function makeGrid(height, size, step, shade) {
  const material = makeMaterial(
    GRID, { uHeight: height, uReach: 6 * size, uStep: step, uShade: shade ? 1 : 0 },
    { transparent: true, depthWrite: false, side: THREE.DoubleSide },
  );
  const mesh = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), material);
  mesh.frustumCulled = false;
  mesh.renderOrder = 3;
  return mesh;
}

function makeDust(size) {
  const count = 1100, position = new Float32Array(3 * count), weight = new Float32Array(count);
  let seed = 1;
  const draw = () => (seed = (seed * 16807) % 2147483647) / 2147483647; // the same dust every time
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < 3; k++) position[3 * i + k] = draw();
    weight[i] = draw() ** 3;
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(position, 3));
  geometry.setAttribute("weight", new THREE.BufferAttribute(weight, 1));
  const material = makeMaterial(
    DUST, { uDrift: new THREE.Vector3(), uBox: 7 * size, uPixels: 1 },
    { transparent: true, depthWrite: false },
  );
  const points = new THREE.Points(geometry, material);
  points.frustumCulled = false;
  points.renderOrder = 5;
  return { points, material };
}

// Where a point is farther than `leap` from the one before, the trail is cut.
function makeTrail(track, time, leap = Infinity) {
  const n = track.count, at = (k, out) => track.values.slice(3 * k, 3 * k + 3).forEach((x, i) => (out[i] = x));
  const fields = { position: 3, before: 3, after: 3, side: 1, moment: 1 }, arrays = {};
  for (const name in fields) arrays[name] = new Float32Array(2 * n * fields[name]);
  const index = [], p = [0, 0, 0];
  for (let k = 0; k < n; k++) {
    for (const half of [0, 1]) {
      const v = 2 * k + half;
      for (const [name, row] of [["position", k], ["before", Math.max(k - 1, 0)], ["after", Math.min(k + 1, n - 1)]]) {
        at(row, p);
        arrays[name].set(p, 3 * v);
      }
      arrays.side[v] = 2 * half - 1;
      arrays.moment[v] = k * time.step;
    }
    const here = 3 * k, next = here + 3, v = track.values;
    const far = k + 1 < n ? Math.hypot(v[next] - v[here], v[next + 1] - v[here + 1], v[next + 2] - v[here + 2]) : Infinity;
    if (far < leap) index.push(2 * k, 2 * k + 1, 2 * k + 2, 2 * k + 1, 2 * k + 3, 2 * k + 2);
  }
  const geometry = new THREE.BufferGeometry();
  for (const name in fields) geometry.setAttribute(name, new THREE.BufferAttribute(arrays[name], fields[name]));
  geometry.setIndex(index);
  const material = makeMaterial(
    TRAIL, { uScreen: new THREE.Vector2(1, 1), uWidth: 3, uNow: 0 },
    { transparent: true, depthWrite: false, side: THREE.DoubleSide },
  );
  const mesh = new THREE.Mesh(geometry, material);
  mesh.frustumCulled = false;
  mesh.renderOrder = 4;
  return { mesh, material };
}

// --------------------------------------------------------------------- forces

// Arrows of one kind of force, one for each module; `scale` is metres per newton.
function makeArrows(kind, anchors, robot, step, size) {
  const count = anchors.length, track = new Track(kind.force, 3 * count, step);
  const shaft = new THREE.CylinderGeometry(1, 1, 1, 12, 1).translate(0, 0.5, 0);
  const head = new THREE.ConeGeometry(1, 1, 20).translate(0, 0.5, 0);
  const color = new THREE.Vector3(...kind.color), group = new THREE.Group();
  const meshes = [shaft, head].map((geometry) => {
    // Twice: faintly through what hides them, and as they are.
    const solid = new THREE.InstancedMesh(geometry, makeMaterial(ARROW, { uColor: color, uAlpha: 1 }), count);
    const ghost = new THREE.InstancedMesh(
      geometry,
      makeMaterial(ARROW, { uColor: color, uAlpha: 0.35 }, { transparent: true, depthTest: false, depthWrite: false }),
      count,
    );
    ghost.instanceMatrix = solid.instanceMatrix;
    ghost.renderOrder = 6;
    for (const mesh of [solid, ghost]) {
      mesh.frustumCulled = false;
      group.add(mesh);
    }
    return solid;
  });
  group.visible = false;
  const from = new THREE.Vector3(), force = new THREE.Vector3(), along = new THREE.Vector3();
  const turn = new THREE.Quaternion(), up = new THREE.Vector3(0, 1, 0), stretch = new THREE.Vector3();
  const matrix = new THREE.Matrix4(), nothing = new THREE.Matrix4().makeScale(0, 0, 0);
  const thick = 0.0085 * size, wide = 0.024 * size, tip = 0.055 * size;
  return {
    group,
    scale: kind.scale,
    update(time) {
      for (let k = 0; k < count; k++) {
        track.vector(time, k, force);
        const length = force.length() * this.scale;
        if (length < 0.004 * size) {
          for (const mesh of meshes) mesh.setMatrixAt(k, nothing);
          continue;
        }
        from.fromArray(anchors[k].place).applyMatrix4(robot.bodies[anchors[k].body].matrixWorld);
        along.copy(force).normalize();
        turn.setFromUnitVectors(up, along);
        const small = Math.min(1, length / (1.6 * tip)), head = tip * small;
        stretch.set(thick * small, length - head, thick * small);
        meshes[0].setMatrixAt(k, matrix.compose(from, turn, stretch));
        stretch.set(wide * small, head, wide * small);
        meshes[1].setMatrixAt(k, matrix.compose(from.addScaledVector(along, length - head), turn, stretch));
      }
      for (const mesh of meshes) mesh.instanceMatrix.needsUpdate = true;
    },
  };
}

// --------------------------------------------------------------------- the current and the target

// An arrow above the robot along the water's velocity; the fastest is 0.6 body lengths long.
function makeCurrent(data, step, size) {
  const holder = new THREE.Group(), scale = (0.6 * size) / data.fastest;
  const kind = { force: data.velocity, color: [0.45, 1.0, 0.85], scale };
  const arrow = makeArrows(kind, [{ body: 0, place: [0, 0, 0] }], { bodies: [holder] }, step, size);
  const velocity = new Track(data.velocity, 3, step), now = new THREE.Vector3();
  return {
    group: arrow.group,
    at: (time) => velocity.vector(time, 0, now).length(),
    update(time, center) {
      velocity.vector(time, 0, now);
      // Its middle is above the robot.
      holder.position.copy(center).addScaledVector(now, -0.5 * scale);
      holder.position.z += 0.3 * size;
      holder.updateMatrixWorld(true);
      arrow.update(time);
    },
  };
}

// A diamond where the robot is to go, that shines through what hides it.
function makeTarget(size) {
  const meshes = [], group = new THREE.Group(), color = new THREE.Vector3(1.0, 0.25, 0.55);
  for (const solid of [true, false]) {
    const options = solid ? {} : { transparent: true, depthTest: false, depthWrite: false };
    const material = makeMaterial(ARROW, { uColor: color, uAlpha: solid ? 1 : 0.35 }, options);
    for (const up of [1, -1]) {
      const half = new THREE.ConeGeometry(0.6, 1, 24).translate(0, 0.5, 0).rotateX((up * Math.PI) / 2);
      const mesh = new THREE.InstancedMesh(half, material, 1);
      mesh.frustumCulled = false;
      mesh.renderOrder = solid ? 0 : 6;
      meshes.push(mesh);
      group.add(mesh);
    }
  }
  const matrix = new THREE.Matrix4();
  return {
    group,
    update(place) {
      matrix.makeScale(0.12 * size, 0.12 * size, 0.12 * size).setPosition(place);
      for (const mesh of meshes) {
        mesh.setMatrixAt(0, matrix);
        mesh.instanceMatrix.needsUpdate = true;
      }
    },
  };
}

// --------------------------------------------------------------------- the robot's shadow

function makeShadow(size) {
  const target = new THREE.WebGLRenderTarget(1024, 1024, {
    minFilter: THREE.NearestFilter, magFilter: THREE.NearestFilter,
  });
  const camera = new THREE.OrthographicCamera(-1, 1, 1, -1, 0, 1);
  camera.layers.set(1);
  const material = new THREE.ShaderMaterial({ vertexShader: SHADOW.vertex, fragmentShader: SHADOW.fragment });
  const half = new THREE.Matrix4().set(0.5, 0, 0, 0.5, 0, 0.5, 0, 0.5, 0, 0, 0.5, 0.5, 0, 0, 0, 1);
  shared.uShadow.value = target.texture;
  return {
    reach: 0.85 * size, // around what is looked at [m]
    // Robots that are bent by a material of their own bring one for their shadows, too.
    render(renderer, scene, around, bent = []) {
      const far = Math.max(3 * size, 1.5 * this.reach);
      camera.left = camera.bottom = -this.reach;
      camera.right = camera.top = this.reach;
      camera.far = 2 * far;
      camera.updateProjectionMatrix();
      camera.position.copy(around).addScaledVector(shared.uSun.value, far);
      camera.up.set(0, 1, 0);
      camera.lookAt(around);
      camera.updateMatrixWorld(true);
      shared.uShadowMatrix.value.copy(half).multiply(camera.projectionMatrix).multiply(camera.matrixWorldInverse);
      // A texture cannot be read while it is drawn.
      shared.uShadow.value = null;
      if (bent.length) for (const robot of bent) robot.mesh.material = robot.dark;
      else scene.overrideMaterial = material;
      renderer.setRenderTarget(target);
      renderer.setClearColor(0xffffff, 1);
      renderer.clear();
      renderer.render(scene, camera);
      renderer.setRenderTarget(null);
      scene.overrideMaterial = null;
      for (const robot of bent) robot.mesh.material = robot.light;
      shared.uShadow.value = target.texture;
    },
  };
}
