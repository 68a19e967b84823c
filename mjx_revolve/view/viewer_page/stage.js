// What all pages share: the water that is looked into, a camera, instruments, and frames in time.

const byId = (id) => document.getElementById(id);
const status = document.documentElement.dataset; // what a test may read: time, playing, frames

function fail(message) {
  byId("message").textContent = message;
  byId("message").hidden = false;
  status.error = message;
}

// The largest of 1, 2, 5 times a power of ten up to x.
function roundNumber(x) {
  const power = 10 ** Math.floor(Math.log10(x)), digit = x / power;
  return Number(((digit >= 5 ? 5 : digit >= 2 ? 2 : 1) * power).toPrecision(1)); // 0.2, not 0.2000…1
}

function digits(x) {
  return String(Number(x.toPrecision(2)));
}

// Of rings around places, as canvases have it.
const PLACE = `rgba(${PALETTE.place.map((x) => Math.round(255 * x)).join()}, 0.85)`;

function set(element, attributes) {
  for (const name in attributes) element.setAttribute(name, attributes[name]);
}

function disc(context, x, y, radius) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fill();
}

// Seen so that what swims along the heading swims to the right, a little towards the viewer.
const VIEWS = {
  swim: { azimuth: -72, elevation: 11 },
  side: { azimuth: -90, elevation: 0 },
  top: { azimuth: -90, elevation: 89.5 },
  front: { azimuth: 12, elevation: 8 },
  below: { azimuth: -60, elevation: -28 },
};

// Water of a world (`surface`, `waves`, `bed`) around robots of a size [m]; null without WebGL.
function openStage(world, size) {
  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas: byId("view"), antialias: true });
  } catch {
    fail("This page draws with WebGL 2, which this browser does not offer or has switched off.");
    return null;
  }
  renderer.autoClear = false;
  renderer.debug.onShaderError = (gl, program, vertex, fragment) => {
    const log = [vertex, fragment].map((shader) => gl.getShaderInfoLog(shader)).join(" ").trim();
    fail(`A shader did not compile: ${log}`);
    console.error(log);
  };

  maxWaves = Math.max(1, world.waves.length);
  shared.uWaves.value = Array.from({ length: maxWaves }, () => new THREE.Vector4());
  shared.uFade.value = world.waves.length ? world.waves.map((wave) => wave.k) : [0];
  shared.uSurface.value = world.surface;
  shared.uSize.value = size;

  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(38, 1, 0.02 * size, 3000);
  camera.up.set(0, 0, 1);
  const background = makeBackground(), surface = makeSurface(size);
  const dust = makeDust(size), shadow = makeShadow(size);
  scene.add(background.mesh, surface.mesh, dust.points);

  // ------------------------------------------------------------------ the camera

  const controls = new THREE.OrbitControls(camera, renderer.domElement);
  controls.enableDamping = true;
  controls.dampingFactor = 0.12;
  controls.minDistance = 0.3 * size;
  controls.maxDistance = 60 * size;
  controls.zoomSpeed = 0.8;
  const target = controls.target, here = new THREE.Vector3();
  let dirty = true, frames = 0;
  const draw = () => (dirty = true);
  controls.addEventListener("change", draw);

  // Looks at the target from a side; azimuth is from the heading on, angles are in degrees.
  function look({ azimuth, elevation, distance = 1 }, heading) {
    const narrow = Math.min(1, camera.aspect), reach = (distance * 0.86 * size) / Math.tan((camera.fov * Math.PI) / 360) / narrow;
    const a = ((heading + azimuth) * Math.PI) / 180;
    let e = (elevation * Math.PI) / 180;
    // A camera in the surface sees neither side of it well.
    const above = (x) => target.z + reach * Math.sin(x) - world.surface;
    if (Math.abs(elevation) < 60 && above(e) > -0.25 * size && above(e) < 0.45 * size) {
      e = Math.asin(Math.min(0.8, (world.surface + 0.45 * size - target.z) / reach));
    }
    camera.position.set(Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e));
    camera.position.multiplyScalar(reach).add(target);
    controls.update();
    draw();
  }

  const bed = world.bed && { ...world.bed, radius: numbersOf(world.bed.radius), height: numbersOf(world.bed.height) };
  if (bed) scene.add(makeBed(bed));

  // Height of the bed, between its rings.
  function bedAt(x, y) {
    if (!bed) return -Infinity;
    const { center, radius, height, sectors, rings } = bed;
    const r = Math.hypot(x - center[0], y - center[1]), angle = Math.atan2(y - center[1], x - center[0]) / (2 * Math.PI);
    const i = Math.min(Math.max(countUpTo(radius, r) - 1, 0), rings - 2);
    const s = Math.min((r - radius[i]) / (radius[i + 1] - radius[i]), 1);
    const j = (((angle % 1) + 1) % 1) * sectors, j0 = Math.floor(j), t = j - j0;
    const ring = (a) => height[a * sectors + (j0 % sectors)] * (1 - t) + height[a * sectors + ((j0 + 1) % sectors)] * t;
    return ring(i) * (1 - s) + ring(i + 1) * s;
  }

  // The camera goes along to another target.
  function go(to) {
    camera.position.add(to).sub(target);
    target.copy(to);
  }

  // Pixels that a metre has at a distance [m].
  function pixelsAt(far) {
    return renderer.domElement.clientHeight / (2 * far * Math.tan((camera.fov * Math.PI) / 360));
  }

  // Where a place is on the screen, and pixels per metre there; null behind the camera.
  function onScreen(place) {
    const { clientWidth: w, clientHeight: h } = renderer.domElement;
    const p = place.clone().project(camera), pixels = pixelsAt(camera.position.distanceTo(place));
    return Math.abs(p.z) < 1 ? { x: (p.x + 1) * 0.5 * w, y: (1 - p.y) * 0.5 * h, pixels } : null;
  }

  // Where a ray through a place on the screen meets a level plane; null above the horizon.
  function onPlane(x, y, height) {
    const { clientWidth: w, clientHeight: h } = renderer.domElement;
    const ray = new THREE.Vector3((2 * x) / w - 1, 1 - (2 * y) / h, 0.5).unproject(camera).sub(camera.position).normalize();
    const far = (height - camera.position.z) / ray.z;
    if (!(far > 0) || far > 0.9 * controls.maxDistance) return null;
    return camera.position.clone().addScaledVector(ray, far);
  }

  // ------------------------------------------------------------------ instruments

  // A 2D canvas as sharp as the screen.
  function pen(id) {
    const canvas = byId(id), ratio = devicePixelRatio || 1, { clientWidth: w, clientHeight: h } = canvas;
    const [width, height] = [w, h].map((x) => Math.round(x * ratio));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, w, h);
    context.font = "11px system-ui, sans-serif";
    return { context, w, h };
  }

  // The world's axes as the camera sees them, the nearest on top.
  const arms = [...byId("axes").children].map((arm, k) => ({ arm, k, along: new THREE.Vector3() }));
  function drawAxes() {
    const turn = camera.quaternion.clone().invert();
    for (const { arm, k, along } of arms) {
      const { x, y } = along.set(0, 0, 0).setComponent(k, 1).applyQuaternion(turn);
      set(arm.firstChild, { x2: 23 * x, y2: -23 * y });
      set(arm.lastChild, { x: 31 * x, y: -31 * y });
    }
    byId("axes").append(...arms.sort((a, b) => a.along.z - b.along.z).map(({ arm }) => arm));
  }

  // Depths below the surface, down to the bed or to the deepest; the floor is that below a place.
  function drawGauge(depth, deepest, floor) {
    const y = (d) => 27 + (139 * Math.min(Math.max(d, -0.05 * deepest), deepest)) / deepest;
    const scale = byId("scale"), [sand, name] = byId("floor").children, [mark, value] = byId("here").children;
    const line = (d) => `<path d="M36 ${y(d)}h4"/><text x="33" y="${y(d)}">${digits(d)}</text>`;
    const step = roundNumber(deepest / 3.2), count = Math.floor((1.001 * deepest) / step) + 1;
    if (!scale.innerHTML) scale.innerHTML = Array.from({ length: count }, (_, k) => line(k * step)).join("");
    byId("floor").style.display = floor < deepest ? "" : "none";
    set(sand, { y: y(floor), height: 169 - y(floor) });
    name.textContent = y(floor) - y(depth) > 13 ? "bed" : "";
    set(name, { y: Math.min(y(floor) + 5, 170) });
    set(mark, { transform: `translate(0 ${y(depth)})` });
    set(value, { y: y(depth) });
    value.textContent = depth.toFixed(2);
  }

  // ------------------------------------------------------------------ frames

  let pixelRatio = Math.min(devicePixelRatio || 1, 2);

  function resize() {
    renderer.setPixelRatio(pixelRatio);
    renderer.setSize(innerWidth, innerHeight, false);
    camera.aspect = innerWidth / innerHeight;
    camera.updateProjectionMatrix();
    dust.material.uniforms.uPixels.value = (innerHeight * pixelRatio) / (2 * Math.tan((camera.fov * Math.PI) / 360));
    draw();
  }
  addEventListener("resize", resize);

  // Water at a time of the world [s], camera and light for what is looked at; follow: it goes along.
  function place(time, at, follow) {
    shared.uTime.value = time;
    world.waves.forEach((wave, k) => {
      const phase = wave.phase - wave.omega * time;
      shared.uWaves.value[k].set(wave.k * wave.x, wave.k * wave.y, wave.amplitude, phase % (2 * Math.PI));
    });
    here.copy(at);
    if (follow) go(here);
    controls.update();
    const ground = bedAt(camera.position.x, camera.position.y) + 0.06 * size;
    if (camera.position.z < ground) {
      camera.position.z = ground;
      camera.lookAt(target);
    }
    camera.updateMatrixWorld();
    shared.uEye.value.copy(camera.position);
    shared.uTarget.value.copy(here);
    background.update(camera);
    surface.update(here, camera.position);
  }

  let lastTick = performance.now(), slow = 0;

  // Draws for ever: `page.moves(seconds)` says whether time goes on, `page.update(seconds)` places what
  // is seen, `page.show()` writes what instruments show.
  function run(page) {
    function tickFrame(now) {
      requestAnimationFrame(tickFrame);
      // The first tick may lie before the script's own time, and a hidden page has none for long.
      const passed = Math.min(Math.max((now - lastTick) / 1000, 0), 0.25);
      lastTick = now;
      if (page.moves(passed)) {
        dirty = true;
        // A slow machine gets plain panels, then fewer pixels, rather than fewer frames.
        slow = passed > 0.05 ? slow + (passed > 0.12 ? 4 : 1) : Math.max(0, slow - 1);
        if (slow > 12) {
          slow = 0;
          pixelRatio = document.body.classList.contains("plain") ? Math.max(0.5, pixelRatio * 0.75) : pixelRatio;
          document.body.classList.add("plain");
          resize();
        }
      }
      if (controls.update()) dirty = true;
      if (!dirty) return;
      dirty = false;
      page.update(passed);
      shadow.render(renderer, scene, here, stage.meshes);
      renderer.clear();
      renderer.render(scene, camera);
      page.show();
      status.frames = ++frames;
    }
    requestAnimationFrame(tickFrame);
  }

  const stage = {
    scene, camera, controls, target, here, surface, dust, shadow, meshes: [],
    draw, look, go, bedAt, pixelsAt, onScreen, onPlane, pen, drawAxes, drawGauge, resize, place, run,
  };
  return stage;
}
