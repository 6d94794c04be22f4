#include "embree.h"

uint32_t lt_header_version(void) { return RTC_VERSION; }

uint32_t lt_library_version(RTCDevice device) {
  return (uint32_t)rtcGetDeviceProperty(device, RTC_DEVICE_PROPERTY_VERSION);
}

RTCDevice lt_device_new(const char *config, uint32_t *error) {
  RTCDevice device = rtcNewDevice(config);
  *error = device ? RTC_ERROR_NONE : rtcGetDeviceError(NULL);
  return device;
}

void lt_device_on_error(RTCDevice device, RTCErrorFunction function, void *user) {
  rtcSetDeviceErrorFunction(device, function, user);
}

void lt_device_on_memory(RTCDevice device, RTCMemoryMonitorFunction function, void *user) {
  rtcSetDeviceMemoryMonitorFunction(device, function, user);
}

void lt_device_release(RTCDevice device) { rtcReleaseDevice(device); }

RTCScene lt_mesh_scene_new(RTCDevice device, bool robust, size_t vertices,
                           float **vertex_buffer, bool quads, size_t faces,
                           const uint32_t *index_buffer) {
  RTCScene scene = rtcNewScene(device);
  if (!scene) return NULL;
  /* Not COMPACT: with ROBUST, coherent 16-wide occlusion of Debian 12's 3.13.5
   * never returns on AVX-512. Not HIGH: ROBUST silently ignores it. */
  rtcSetSceneFlags(scene, robust ? RTC_SCENE_FLAG_ROBUST : RTC_SCENE_FLAG_NONE);
  rtcSetSceneBuildQuality(scene, RTC_BUILD_QUALITY_MEDIUM);
  RTCGeometry geometry = rtcNewGeometry(device,
      quads ? RTC_GEOMETRY_TYPE_QUAD : RTC_GEOMETRY_TYPE_TRIANGLE);
  if (!geometry) {
    rtcReleaseScene(scene);
    return NULL;
  }
  /* A vertex buffer that Embree allocates carries the padding it reads past the
   * end; indices need none. */
  *vertex_buffer = rtcSetNewGeometryBuffer(geometry, RTC_BUFFER_TYPE_VERTEX, 0,
      RTC_FORMAT_FLOAT3, 3 * sizeof(float), vertices);
  if (!*vertex_buffer) {
    rtcReleaseGeometry(geometry);
    rtcReleaseScene(scene);
    return NULL;
  }
  rtcSetSharedGeometryBuffer(geometry, RTC_BUFFER_TYPE_INDEX, 0,
      quads ? RTC_FORMAT_UINT4 : RTC_FORMAT_UINT3, index_buffer, 0,
      (quads ? 6 : 3) * sizeof(uint32_t), faces);
  rtcAttachGeometryByID(scene, geometry, 0);
  rtcReleaseGeometry(geometry);
  return scene;
}

void lt_scene_on_progress(RTCScene scene, RTCProgressMonitorFunction function, void *user) {
  rtcSetSceneProgressMonitorFunction(scene, function, user);
}

void lt_scene_commit(RTCScene scene) {
  rtcCommitGeometry(rtcGetGeometry(scene, 0));
  rtcCommitScene(scene);
}

void lt_scene_release(RTCScene scene) { rtcReleaseScene(scene); }

#if RTC_VERSION_MAJOR >= 4

void lt_intersect16(RTCScene scene, bool coherent, const int *valid,
                    struct RTCRayHit16 *rays) {
  struct RTCIntersectArguments arguments;
  rtcInitIntersectArguments(&arguments);
  if (coherent) arguments.flags = RTC_RAY_QUERY_FLAG_COHERENT;
  rtcIntersect16(valid, scene, rays, &arguments);
}

void lt_occluded16(RTCScene scene, bool coherent, const int *valid,
                   struct RTCRay16 *rays) {
  struct RTCOccludedArguments arguments;
  rtcInitOccludedArguments(&arguments);
  if (coherent) arguments.flags = RTC_RAY_QUERY_FLAG_COHERENT;
  rtcOccluded16(valid, scene, rays, &arguments);
}

void lt_intersect1(RTCScene scene, struct RTCRayHit *ray) {
  rtcIntersect1(scene, ray, NULL);
}

void lt_occluded1(RTCScene scene, struct RTCRay *ray) {
  rtcOccluded1(scene, ray, NULL);
}

#else

static struct RTCIntersectContext context_of(bool coherent) {
  struct RTCIntersectContext context;
  rtcInitIntersectContext(&context);
  if (coherent) context.flags = RTC_INTERSECT_CONTEXT_FLAG_COHERENT;
  return context;
}

void lt_intersect16(RTCScene scene, bool coherent, const int *valid,
                    struct RTCRayHit16 *rays) {
  struct RTCIntersectContext context = context_of(coherent);
  rtcIntersect16(valid, scene, &context, rays);
}

void lt_occluded16(RTCScene scene, bool coherent, const int *valid,
                   struct RTCRay16 *rays) {
  struct RTCIntersectContext context = context_of(coherent);
  rtcOccluded16(valid, scene, &context, rays);
}

void lt_intersect1(RTCScene scene, struct RTCRayHit *ray) {
  struct RTCIntersectContext context = context_of(false);
  rtcIntersect1(scene, &context, ray);
}

void lt_occluded1(RTCScene scene, struct RTCRay *ray) {
  struct RTCIntersectContext context = context_of(false);
  rtcOccluded1(scene, &context, ray);
}

#endif

void lt_point_query(RTCScene scene, struct RTCPointQuery *query,
                    RTCPointQueryFunction visit, void *user) {
  struct RTCPointQueryContext context;
  rtcInitPointQueryContext(&context);
  rtcPointQuery(scene, query, &context, visit, user);
}
