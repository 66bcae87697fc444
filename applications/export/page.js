// The gzip file that an element holds in base64, unpacked. In pieces, so that no second copy of a large model is made.
const unpacked = (id) => {
  const element = document.getElementById(id), text = element.textContent, step = 1 << 20;
  element.remove();
  let next = 0;
  const packed = new ReadableStream({
    pull(stream) {
      if (next >= text.length) return stream.close();
      stream.enqueue(Uint8Array.from(atob(text.slice(next, next += step)), (letter) => letter.charCodeAt(0)));
    },
  });
  return new Response(packed.pipeThrough(new DecompressionStream('gzip')));
};

// The viewer takes opening angles across the longer side of the window; the settings have vertical ones. A photo of
// another aspect fills the window, as nobody has seen what is around it, but most of its height and width is shown:
// the window has up to twice the photo's height.
const least = 0.85, most = 2;
const heights = (photo) => {
  const share = photo / (innerWidth / innerHeight);
  return share < 1 ? Math.max(share, least) : Math.min(Math.max(1, least * share), most);
};
const fit = (degrees, photo) => {
  const longer = Math.max(innerWidth / innerHeight, 1);
  return Math.atan(Math.tan(degrees * Math.PI / 360) * heights(photo) * longer) * 360 / Math.PI;
};

// Around a photo that does not fill the window nobody saw much: that fades out until a guest moves.
const fadeSides = (photo) => {
  const sides = document.querySelector('.sse-sceneLayer').appendChild(document.createElement('div'));
  const color = getComputedStyle(document.body).backgroundColor;
  sides.style = 'position: absolute; inset: 0; pointer-events: none; transition: opacity 1s';
  const draw = () => {
    const height = heights(photo), width = height / photo * innerWidth / innerHeight;
    sides.style.background = [[width, 90], [height, 0]].filter(([times]) => times > 1.001).map(([times, degrees]) => {
      const side = 50 - 50 / times;
      return `linear-gradient(${degrees}deg, ${color}, transparent ${side}%, transparent ${100 - side}%, ${color})`;
    }).join() || 'none';
  };
  draw();
  addEventListener('resize', draw);
  for (const moved of ['pointerdown', 'wheel', 'keydown']) addEventListener(moved, () => sides.style.opacity = 0, true);
};

// The viewer keeps whether its help is open. It would cover a part of the model, so it begins closed.
const closeHelp = () => {
  const key = 'controlsPanelOpen';
  try {
    if (localStorage.getItem(key) === null) localStorage.setItem(key, 'false');
  } catch { /* nothing is kept on this machine */ }
};

// Keys that open and close the title's text are not the viewer's.
const about = document.getElementById('about');
about.addEventListener('keydown', (event) => {
  if (event.key === 'Escape') about.open = false;
  event.stopPropagation();
});

// The viewer asks for what is solid by an address; the answer is in this file.
const answer = ({ address, about }) => {
  const content = unpacked('solid'), elsewhere = window.fetch.bind(window);
  window.fetch = (asked, ...rest) => {
    if (asked === address) return Promise.resolve(new Response(about));
    return asked === address.replace('.json', '.bin') ? Promise.resolve(content) : elsewhere(asked, ...rest);
  };
};

// Nobody leaves what the photos show. The viewer places its camera by a vector of its own, which is held within the
// limits on the way. From there its controls begin anew, where they would fly or pinch on from beyond; the wheel leads
// no further. Who walks is kept by rails.
const limited = (viewer, [low, high]) => {
  const camera = viewer.app.root.findByName('camera'), { events, state } = viewer, put = camera.setPosition.bind(camera);
  let held = false, outside = false, touched = false;
  camera.setPosition = (place, ...rest) => {
    if (place instanceof Object && !state.xrMode && ['orbit', 'fly'].includes(state.cameraMode)) {
      const { x, y, z } = place;
      place.set(...[x, y, z].map((value, i) => Math.min(Math.max(value, low[i]), high[i])));
      held ||= place.x !== x || place.y !== y || place.z !== z;
    }
    return put(place, ...rest);
  };
  for (const name of ['touchstart', 'touchend', 'touchcancel']) {
    addEventListener(name, ({ touches }) => { touched = touches.length > 0; }, true);
  }
  const stop = (event) => { if (outside && state.cameraMode === 'orbit' && event.deltaY > 0) event.stopPropagation(); };
  addEventListener('wheel', stop, true);
  return () => {
    [outside, held] = [held, false];
    if (outside && (touched || state.cameraMode === 'fly')) {
      events.fire('cameraMode:changed', state.cameraMode, state.cameraMode);
    }
  };
};

// In a headset a guest stands where the picture was taken, and looks ahead; the viewer itself would begin on the plane
// y = 0 and might face the other way. metre: in units of the model.
const standing = (viewer, metre) => {
  const camera = viewer.app.root.findByName('camera'), rig = camera.parent, eyes = 1.6;
  let place, yaw;
  viewer.events.on('xrMode:changed', (mode) => {
    rig.setLocalScale(...Array(3).fill(mode ? metre : 1));
    if (!mode) return;
    rig.setPosition(place.x, place.y - eyes * metre, place.z);
    rig.setEulerAngles(0, yaw, 0);
  });
  return () => {
    if (viewer.state.xrMode) return;
    place = camera.getPosition().clone();
    yaw = Math.atan2(-camera.forward.x, -camera.forward.z) * 180 / Math.PI;
  };
};

// The viewer's cameras are level, and those of the photos were not always. At a bookmark the picture leans as its photo
// does. Away from there it gets level: at a tenth of the way to what the photo shows, or as many radians. The animation
// is level.
const leaning = (viewer, annotations) => {
  const between = (a, b) => Math.hypot(...a.map((value, i) => value - b[i]));
  const bookmarks = annotations.map(({ extras, camera: { initial: { position, target } } }) => {
    const depth = between(target, position);
    return { lean: extras.lean, position, depth, forward: target.map((value, i) => (value - position[i]) / depth) };
  });
  const camera = viewer.app.root.findByName('camera');
  let shown = null;
  return (seconds) => {
    if (viewer.state.xrMode) return;
    const { x, y, z } = camera.getPosition(), { forward } = camera;
    let wanted = 0, most = 0;
    for (const mark of viewer.state.cameraMode === 'anim' ? [] : bookmarks) {
      const gap = between([x, y, z], mark.position) / mark.depth + between([forward.x, forward.y, forward.z], mark.forward);
      const weight = Math.max(0, 1 - 10 * gap);
      if (weight > most) [most, wanted] = [weight, weight * mark.lean];
    }
    shown = shown === null ? wanted : shown + (wanted - shown) * Math.min(1, 8 * seconds);
    camera.rotateLocal(0, 0, shown);
  };
};

// Whether a headset is there, which draws by WebGL alone. A frame may not ask.
const headset = () => window === window.top && navigator.xr?.isSessionSupported('immersive-vr').catch(() => false);

try {
  // Angles are fitted to the size of the window. In a frame this runs before there is a size; a hidden frame has none.
  while (!innerWidth || !innerHeight) await new Promise(requestAnimationFrame);
  const { antialiasing, aspect, limits, metre, name, settings, solid } = JSON.parse(document.getElementById('page').textContent);
  for (const { initial } of settings.cameras) initial.fov = fit(initial.fov, aspect);
  for (const { camera: { initial }, extras } of settings.annotations) initial.fov = fit(initial.fov, extras.aspect);
  for (const { keyframes: { values } } of settings.animTracks) values.fov = values.fov.map((degrees) => fit(degrees, Math.max(aspect, innerWidth / innerHeight)));
  closeHelp();
  if (solid) answer(solid);
  const code = new Blob([await unpacked('viewer').text()], { type: 'text/javascript' });
  const { createViewer } = await import(URL.createObjectURL(code));
  // The name is given, too, as the viewer cannot take it from an address in a frame whose own is about:srcdoc.
  const viewer = await createViewer({
    container: document.body, settings, contentUrl: name, contentFilename: name,
    contents: Promise.resolve(unpacked('model')), noanim: true, collisionUrl: solid?.address,
    renderer: (await headset()) ? 'webgl' : undefined,
  });
  viewer.app.scene.gsplat.antiAlias = antialiasing;
  fadeSides(aspect);
  viewer.app.on('update', limited(viewer, limits));
  viewer.app.on('update', standing(viewer, metre));
  viewer.app.on('update', leaning(viewer, settings.annotations));
  const begin = () => viewer.resetCamera(); // at the first camera; the viewer itself begins in its animation
  viewer.state.loaded ? begin() : viewer.events.once('loaded:changed', begin);
  window.viewer = viewer;
} catch (error) {
  const failure = document.body.appendChild(document.createElement('p'));
  failure.id = 'failure';
  failure.textContent = `The model cannot be shown: ${error.message}. A browser of 2023 or later, with WebGL 2, shows it.`;
  throw error;
}
